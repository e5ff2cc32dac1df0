//! A map that keeps the order of the structure file.

use serde::{Serialize, Serializer};

/// Values by name in insertion order. In JSON, they are an object in that order.
#[derive(Debug, Clone, PartialEq)]
pub struct Ordered<T>(Vec<(String, T)>);

impl<T> Default for Ordered<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T> Ordered<T> {
    /// Appends a value. Names must be unique.
    pub fn push(&mut self, name: String, value: T) {
        self.0.push((name, value));
    }

    /// Returns names and values in order.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &T)> {
        self.0.iter().map(|(name, value)| (name.as_str(), value))
    }

    /// Returns the values in order.
    pub fn values(&self) -> impl Iterator<Item = &T> {
        self.0.iter().map(|(_, value)| value)
    }
}

impl<T: Serialize> Serialize for Ordered<T> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.iter())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_keeps_the_order() {
        let mut ordered = Ordered::default();
        ordered.push("third".to_owned(), 3);
        ordered.push("first".to_owned(), 1);
        assert_eq!(
            serde_json::to_string(&ordered).unwrap(),
            r#"{"third":3,"first":1}"#
        );
    }
}
