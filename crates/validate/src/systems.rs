//! Systems of the examples that no structure file describes.

pub(crate) mod linear;
