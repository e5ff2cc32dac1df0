//! Reads the keys of a table of the configuration, and collects all mistakes.

use std::collections::BTreeMap;

use serde_json::{Map, Value};

use crate::mistake::Mistake;

/// A table of the configuration. Keys that nothing has read are reported as unknown.
pub(crate) struct Section<'a> {
    place: String,
    unread: BTreeMap<&'a str, &'a Value>,
    known: Vec<&'static str>,
}

impl<'a> Section<'a> {
    /// Creates a reader of `table`, whose key is `place`.
    pub(crate) fn new(place: String, table: &'a Map<String, Value>) -> Self {
        let unread = table
            .iter()
            .map(|(key, value)| (key.as_str(), value))
            .collect();
        Self {
            place,
            unread,
            known: Vec::new(),
        }
    }

    /// Returns the full name of a key.
    pub(crate) fn key(&self, key: &str) -> String {
        format!("{}.{key}", self.place)
    }

    /// Reports a mistake of a key.
    pub(crate) fn report(
        &self,
        key: &str,
        found: impl Into<String>,
        allowed: impl Into<String>,
        mistakes: &mut Vec<Mistake>,
    ) {
        mistakes.push(Mistake {
            key: self.key(key),
            found: found.into(),
            allowed: allowed.into(),
        });
    }

    fn take(&mut self, key: &'static str) -> Option<&'a Value> {
        self.known.push(key);
        self.unread.remove(key)
    }

    fn wrong<T>(
        &self,
        key: &str,
        value: &Value,
        allowed: &str,
        mistakes: &mut Vec<Mistake>,
    ) -> Option<T> {
        self.report(key, format!("is {value}"), allowed, mistakes);
        None
    }

    /// Returns a value without marking its key as read.
    pub(crate) fn peek(&self, key: &str) -> Option<&'a Value> {
        self.unread.get(key).copied()
    }

    /// Returns a text.
    pub(crate) fn text(
        &mut self,
        key: &'static str,
        mistakes: &mut Vec<Mistake>,
    ) -> Option<String> {
        match self.take(key)? {
            Value::String(text) if !text.is_empty() => Some(text.clone()),
            other => self.wrong(key, other, "must be a text that is not empty", mistakes),
        }
    }

    /// Returns a text that must be present. `allowed` describes it.
    pub(crate) fn required_text(
        &mut self,
        key: &'static str,
        allowed: &str,
        mistakes: &mut Vec<Mistake>,
    ) -> Option<String> {
        if !self.unread.contains_key(key) {
            self.known.push(key);
            self.report(key, "is missing", allowed, mistakes);
            return None;
        }
        self.text(key, mistakes)
    }

    /// Returns one of the given words. Returns `None` if the key is absent or wrong.
    pub(crate) fn choice<T: Copy>(
        &mut self,
        key: &'static str,
        words: &[(&str, T)],
        mistakes: &mut Vec<Mistake>,
    ) -> Option<T> {
        let value = self.take(key)?;
        let found = value
            .as_str()
            .and_then(|text| words.iter().find(|(word, _)| *word == text));
        match found {
            Some((_, meaning)) => Some(*meaning),
            None => self.wrong(key, value, &one_of(words), mistakes),
        }
    }

    /// Returns a number that `is_allowed` accepts.
    pub(crate) fn number(
        &mut self,
        key: &'static str,
        is_allowed: impl Fn(f64) -> bool,
        allowed: &str,
        mistakes: &mut Vec<Mistake>,
    ) -> Option<f64> {
        let value = self.take(key)?;
        match value
            .as_f64()
            .filter(|number| number.is_finite() && is_allowed(*number))
        {
            Some(number) => Some(number),
            None => self.wrong(key, value, allowed, mistakes),
        }
    }

    /// Returns a list of texts.
    pub(crate) fn texts(
        &mut self,
        key: &'static str,
        mistakes: &mut Vec<Mistake>,
    ) -> Option<Vec<String>> {
        let value = self.take(key)?;
        let texts: Option<Vec<String>> = value.as_array().and_then(|items| {
            items
                .iter()
                .map(|item| item.as_str().map(str::to_owned))
                .collect()
        });
        match texts {
            Some(texts) if !texts.is_empty() => Some(texts),
            _ => self.wrong(key, value, "must be a list of texts", mistakes),
        }
    }

    /// Returns a list of tables, each with its own key.
    pub(crate) fn tables(
        &mut self,
        key: &'static str,
        mistakes: &mut Vec<Mistake>,
    ) -> Vec<Section<'a>> {
        let Some(value) = self.take(key) else {
            return Vec::new();
        };
        let tables: Option<Vec<&Map<String, Value>>> = value
            .as_array()
            .and_then(|items| items.iter().map(Value::as_object).collect());
        match tables {
            Some(tables) => (0..)
                .zip(tables)
                .map(|(index, table)| Section::new(self.key(&format!("{key}[{index}]")), table))
                .collect(),
            None => {
                let allowed = format!("must be tables: [[…{key}]]");
                self.report(key, "is not a list of tables", allowed, mistakes);
                Vec::new()
            }
        }
    }

    /// Reports keys that nothing has read.
    pub(crate) fn finish(mut self, mistakes: &mut Vec<Mistake>) {
        self.known.sort_unstable();
        self.known.dedup();
        for key in self.unread.keys() {
            let allowed = format!("must be one of {}", self.known.join(", "));
            self.report(key, "is an unknown key here", allowed, mistakes);
        }
    }
}

/// Returns a description of the allowed words.
pub(crate) fn one_of<T>(words: &[(&str, T)]) -> String {
    let words: Vec<String> = words
        .iter()
        .map(|(word, _)| format!("\"{word}\""))
        .collect();
    format!("must be one of {}", words.join(", "))
}
