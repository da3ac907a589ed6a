//! Arguments and exit codes.

mod recipe_flags;

pub use recipe_flags::RecipeFlags;
