//! A result that a structure computes at its first use.

use std::sync::OnceLock;

/// A result that follows from the structure and takes seconds for a large one.
///
/// A clone starts without it, because the clone may be changed.
#[derive(Debug)]
pub(crate) struct Computed<T>(OnceLock<T>);

impl<T> Computed<T> {
    /// Returns the result, computed by `compute` at the first use.
    pub(crate) fn get_or_init(&self, compute: impl FnOnce() -> T) -> &T {
        self.0.get_or_init(compute)
    }
}

impl<T: Clone> Computed<T> {
    /// Returns the result for a changed structure, for which it is right as well.
    pub(crate) fn kept(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<T> Default for Computed<T> {
    fn default() -> Self {
        Self(OnceLock::new())
    }
}

impl<T> Clone for Computed<T> {
    fn clone(&self) -> Self {
        Self::default()
    }
}
