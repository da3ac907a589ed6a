//! Pickles and JSON texts that cost far more memory to read than they have bytes.
