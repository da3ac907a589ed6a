//! Tiny counts, empty inputs and one extreme value per attribute.
