//! Player: a page that plays a scene in any browser, without a server and without network requests.
//!
//! [`track`] turns frames into chunks of bytes on the grid of [`lattice`]. [`page`] puts the chunks and the program
//! that shows them (`page/`, WebGL 2 with the arithmetic of [`crate::render`]) into one file or into a folder.
//! [`poster`] is the first image.

pub mod lattice;
pub mod page;
pub mod poster;
pub mod track;
pub mod view;
