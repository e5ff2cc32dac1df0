//! Responses of the structure whose estimates the owner asks for: displacements and velocities that no sensor measures.

/// A weighted sum of entries of the state, with the name under which its estimate is written.
#[derive(Debug, Clone, PartialEq)]
pub struct EstimatedResponse {
    pub(crate) name: String,
    /// Entries of the state (from 0) with their coefficients.
    pub(crate) terms: Vec<(usize, f64)>,
}

impl EstimatedResponse {
    /// Returns the name, unique among parameters and responses.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the entries of the state `[x, ẋ]` (from 0) with their coefficients.
    #[must_use]
    pub fn terms(&self) -> &[(usize, f64)] {
        &self.terms
    }
}
