//! Responses that the structure file requests as estimates: displacements and velocities that no
//! sensor measures.

/// A weighted sum of state entries, with the name of its estimate.
#[derive(Debug, Clone, PartialEq)]
pub struct EstimatedResponse {
    pub(crate) name: String,
    /// State entries (from 0) with their coefficients.
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
