//! Player: a page that plays a scene in any browser, without a server and without network requests.
//!
//! [`track`] encodes frames as chunks of bytes, with values on the quantization grid of [`quantization`]. [`page`] puts
//! the chunks and the program that shows them (`page/`, WebGL 2 with the arithmetic of [`crate::render`]) into one file
//! or into a folder. [`poster`] renders the image that the page shows first.

pub mod page;
pub mod poster;
pub mod quantization;
pub mod track;
pub mod view;
