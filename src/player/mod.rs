//! The player: a page that plays a scene in any browser, without a server and without asking for anything.
//!
//! [`track`] turns frames into chunks of bytes, as points of a [`lattice`]; [`page`] puts them and the program that shows
//! them (`page/`, WebGL 2 with the arithmetic of [`crate::render`]) into one file, or into a folder.

pub mod lattice;
pub mod page;
pub mod track;
pub mod view;
