//! Binary inputs that announce more than they hold: PLY files, frame streams, containers, archives and arrays.
