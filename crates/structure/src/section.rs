//! Reads one table of the structure file key by key and continues after every mistake.
//!
//! A derived deserialiser stops at the first wrong type. This reader keeps the span of each key and
//! value, so that one pass finds all mistakes in a file, each with its line.

use crate::diagnostics::{Diagnostics, counted, one_of};
use std::fmt;
use std::ops::{Bound, Range};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// Range of numbers that a key allows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Allowed {
    low: Bound<f64>,
    high: Bound<f64>,
}

impl Allowed {
    pub(crate) const ANY: Self = Self {
        low: Bound::Unbounded,
        high: Bound::Unbounded,
    };
    pub(crate) const POSITIVE: Self = Self {
        low: Bound::Excluded(0.0),
        high: Bound::Unbounded,
    };
    pub(crate) const NOT_NEGATIVE: Self = Self {
        low: Bound::Included(0.0),
        high: Bound::Unbounded,
    };
    pub(crate) const FROM_ONE: Self = Self {
        low: Bound::Included(1.0),
        high: Bound::Unbounded,
    };
    /// Range of the factor by which a level may be off.
    pub(crate) const FACTOR: Self = Self {
        low: Bound::Included(1.0),
        high: Bound::Included(1000.0),
    };
    /// Range above 0 and below 1.
    pub(crate) const INSIDE_UNIT: Self = Self {
        low: Bound::Excluded(0.0),
        high: Bound::Excluded(1.0),
    };
    /// Range of frame rates (Hz). The bus can carry the maximum, and structures move no faster.
    pub(crate) const RATE: Self = Self {
        low: Bound::Included(1e-3),
        high: Bound::Included(20_000.0),
    };
    /// Range of standard deviations whose squares, sums and ratios are finite and not zero.
    pub(crate) const DEVIATION: Self = Self {
        low: Bound::Included(1e-30),
        high: Bound::Included(1e30),
    };
    /// Range of standard deviations of ratios.
    pub(crate) const RATIO_DEVIATION: Self = Self {
        low: Bound::Included(1e-9),
        high: Bound::Included(1e6),
    };
    /// Range of the rate error of a clock (parts per million): a hundred times that of crystals.
    pub(crate) const DRIFT: Self = Self {
        low: Bound::Included(-10_000.0),
        high: Bound::Included(10_000.0),
    };
    /// Range of latitudes (degrees).
    pub(crate) const LATITUDE: Self = Self {
        low: Bound::Included(-90.0),
        high: Bound::Included(90.0),
    };
    /// Range of longitudes (degrees).
    pub(crate) const LONGITUDE: Self = Self {
        low: Bound::Included(-180.0),
        high: Bound::Included(180.0),
    };
    /// Range from 0 to below 1.
    pub(crate) const SHARE: Self = Self {
        low: Bound::Included(0.0),
        high: Bound::Excluded(1.0),
    };

    fn contains(self, value: f64) -> bool {
        value.is_finite() && std::ops::RangeBounds::contains(&(self.low, self.high), &value)
    }
}

/// Formats a bound, with an exponent if it is very large or small.
pub(crate) fn short(bound: f64) -> String {
    let plain = bound == 0.0 || (1e-3..1e6).contains(&bound.abs());
    if plain {
        bound.to_string()
    } else {
        format!("{bound:e}")
    }
}

impl fmt::Display for Allowed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let low = match self.low {
            Bound::Included(low) => Some(format!("from {}", short(low))),
            Bound::Excluded(low) => Some(format!("above {}", short(low))),
            Bound::Unbounded => None,
        };
        let high = match self.high {
            Bound::Included(high) => Some(format!("up to {}", short(high))),
            Bound::Excluded(high) => Some(format!("below {}", short(high))),
            Bound::Unbounded => None,
        };
        f.write_str("must be a finite number")?;
        match (low, high) {
            (Some(low), Some(high)) => write!(f, " {low} and {high}"),
            (Some(one), None) | (None, Some(one)) => write!(f, " {one}"),
            (None, None) => Ok(()),
        }
    }
}

/// A degree of freedom or a node, given by number from 1 or by name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum NumberOrName {
    Number(i64),
    Name(String),
}

/// A table while it is read.
pub(crate) struct Section<'t> {
    table: &'t DeTable<'t>,
    name: String,
    span: Range<usize>,
    known: Vec<&'static str>,
    /// Keys that were refused. They count as missing.
    refused: Vec<&'static str>,
    diagnostics: &'t Diagnostics<'t>,
}

impl<'t> Section<'t> {
    pub(crate) fn new(
        table: &'t DeTable<'t>,
        name: impl Into<String>,
        span: Range<usize>,
        diagnostics: &'t Diagnostics<'t>,
    ) -> Self {
        Self {
            table,
            name: name.into(),
            span,
            known: Vec::new(),
            refused: Vec::new(),
            diagnostics,
        }
    }

    /// Returns the position of the table.
    pub(crate) fn span(&self) -> Range<usize> {
        self.span.clone()
    }

    /// Returns `table.key` for messages.
    pub(crate) fn key(&self, key: &str) -> String {
        if self.name.is_empty() {
            key.to_owned()
        } else {
            format!("{}.{key}", self.name)
        }
    }

    pub(crate) fn diagnostics(&self) -> &'t Diagnostics<'t> {
        self.diagnostics
    }

    pub(crate) fn contains(&self, key: &str) -> bool {
        self.table.contains_key(key) && !self.refused.contains(&key)
    }

    /// Reports keys that must not be given here. Later calls do not find them.
    pub(crate) fn refuse_keys(&mut self, keys: &[&'static str], allowed: &str) {
        for key in keys.iter().filter(|key| self.contains(key)) {
            let key_span = self.table.keys().find(|known| known.get_ref() == key);
            let span = key_span.map_or_else(|| self.span(), Spanned::span);
            self.diagnostics
                .report(span, self.key(key), "is given", allowed);
        }
        self.refused.extend(keys);
        self.known.extend(keys);
    }

    /// Returns `true` if the value of a key is a list.
    pub(crate) fn is_list(&self, key: &str) -> bool {
        let value = self.table.get(key);
        value.is_some_and(|value| value.get_ref().as_array().is_some())
    }

    /// Returns the position of the value of a key, or of the table if the key is missing.
    pub(crate) fn span_of(&self, key: &str) -> Range<usize> {
        self.table
            .get(key)
            .map_or_else(|| self.span(), Spanned::span)
    }

    /// Reports a missing `key`. A present but wrong value has already been reported.
    pub(crate) fn require<T>(
        &self,
        key: &str,
        allowed: impl fmt::Display,
        value: Option<T>,
    ) -> Option<T> {
        if !self.contains(key) {
            self.diagnostics.report(
                self.span(),
                self.key(key),
                "is missing",
                allowed.to_string(),
            );
        }
        value
    }

    /// Marks keys as known without reading them, because a reported mistake prevents their check.
    pub(crate) fn leave_unread(&mut self, keys: &[&'static str]) {
        self.known.extend(keys);
    }

    /// Reports unknown keys.
    pub(crate) fn finish(self) {
        for (key, _) in self.table {
            if !self.known.contains(&key.get_ref().as_ref()) {
                let hint = one_of(key.get_ref(), self.known.iter().copied());
                self.diagnostics.report(
                    key.span(),
                    self.key(key.get_ref()),
                    "is not a known key",
                    hint,
                );
            }
        }
    }

    /// Reports a value that its key does not allow.
    pub(crate) fn refuse(
        &self,
        key: &str,
        value: &Spanned<DeValue<'t>>,
        allowed: impl fmt::Display,
    ) {
        self.diagnostics.report(
            value.span(),
            self.key(key),
            describe(value.get_ref()),
            allowed.to_string(),
        );
    }

    fn value(&mut self, key: &'static str) -> Option<&'t Spanned<DeValue<'t>>> {
        self.known.push(key);
        self.table.get(key).filter(|_| !self.refused.contains(&key))
    }

    /// Reads a number; an integer is also a number.
    pub(crate) fn number(&mut self, key: &'static str, allowed: Allowed) -> Option<Spanned<f64>> {
        let value = self.value(key)?;
        self.check_number(key, value, allowed)
    }

    /// Reads a required number.
    pub(crate) fn required_number(
        &mut self,
        key: &'static str,
        allowed: Allowed,
    ) -> Option<Spanned<f64>> {
        let value = self.number(key, allowed);
        self.require(key, allowed, value)
    }

    /// Reads a number, with a default.
    pub(crate) fn number_or(&mut self, key: &'static str, allowed: Allowed, default: f64) -> f64 {
        self.number(key, allowed)
            .map_or(default, Spanned::into_inner)
    }

    /// Reads a list of numbers.
    pub(crate) fn numbers(
        &mut self,
        key: &'static str,
        allowed: Allowed,
    ) -> Option<Spanned<Vec<f64>>> {
        let value = self.value(key)?;
        self.check_numbers(key, value, allowed)
    }

    /// Reads a list of numbers under a user-defined name, an entry of [`Section::entries`].
    pub(crate) fn entry_numbers(
        &self,
        key: &str,
        name: &Spanned<String>,
        value: &Spanned<DeValue<'t>>,
        allowed: Allowed,
    ) -> Option<Spanned<Vec<f64>>> {
        self.check_numbers(&format!("{key}.{}", name.get_ref()), value, allowed)
    }

    fn check_numbers(
        &self,
        key: &str,
        value: &Spanned<DeValue<'t>>,
        allowed: Allowed,
    ) -> Option<Spanned<Vec<f64>>> {
        let Some(entries) = value.get_ref().as_array() else {
            self.refuse(key, value, "must be a list of numbers");
            return None;
        };
        let numbers: Vec<_> = entries
            .iter()
            .map(|entry| self.check_number(key, entry, allowed))
            .collect();
        let numbers: Option<Vec<f64>> = numbers
            .into_iter()
            .map(|n| n.map(Spanned::into_inner))
            .collect();
        numbers.map(|numbers| Spanned::new(value.span(), numbers))
    }

    /// Reads a list of `len` numbers, or one number that applies to each of `len` entries.
    pub(crate) fn number_for_each(
        &mut self,
        key: &'static str,
        allowed: Allowed,
        len: usize,
    ) -> Option<Vec<f64>> {
        if self
            .table
            .get(key)
            .is_some_and(|value| value.get_ref().is_array())
        {
            let numbers = self.numbers(key, allowed)?;
            if numbers.get_ref().len() != len {
                let found = format!(
                    "has {}",
                    counted(numbers.get_ref().len(), "entry", "entries")
                );
                self.diagnostics.report(
                    numbers.span(),
                    self.key(key),
                    found,
                    format!("must have {len}"),
                );
                return None;
            }
            return Some(numbers.into_inner());
        }
        self.number(key, allowed)
            .map(|number| vec![number.into_inner(); len])
    }

    /// Reads a number under a user-defined name, an entry of [`Section::entries`].
    pub(crate) fn entry_number(
        &self,
        key: &str,
        name: &Spanned<String>,
        value: &Spanned<DeValue<'t>>,
        allowed: Allowed,
    ) -> Option<f64> {
        self.check_number(&format!("{key}.{}", name.get_ref()), value, allowed)
            .map(Spanned::into_inner)
    }

    fn check_number(
        &self,
        key: &str,
        value: &Spanned<DeValue<'t>>,
        allowed: Allowed,
    ) -> Option<Spanned<f64>> {
        let number = match value.get_ref() {
            DeValue::Float(float) => float.as_str().parse().ok(),
            DeValue::Integer(integer) => i64::from_str_radix(integer.as_str(), integer.radix())
                .ok()
                .map(|whole| whole as f64),
            _ => None,
        };
        match number {
            Some(number) if allowed.contains(number) => Some(Spanned::new(value.span(), number)),
            _ => {
                self.refuse(key, value, allowed);
                None
            }
        }
    }

    /// Reads an integer from `low` to `high`.
    pub(crate) fn whole(
        &mut self,
        key: &'static str,
        low: usize,
        high: usize,
    ) -> Option<Spanned<usize>> {
        let value = self.value(key)?;
        let whole = whole_number(value.get_ref()).and_then(|whole| usize::try_from(whole).ok());
        match whole {
            Some(whole) if (low..=high).contains(&whole) => Some(Spanned::new(value.span(), whole)),
            _ => {
                self.refuse(
                    key,
                    value,
                    format!("must be a whole number from {low} to {high}"),
                );
                None
            }
        }
    }

    /// Reads `true` or `false`.
    pub(crate) fn flag(&mut self, key: &'static str) -> Option<bool> {
        let value = self.value(key)?;
        let flag = value.get_ref().as_bool();
        if flag.is_none() {
            self.refuse(key, value, "must be true or false");
        }
        flag
    }

    /// Reads `true` or `false`, with a default.
    pub(crate) fn flag_or(&mut self, key: &'static str, default: bool) -> bool {
        self.flag(key).unwrap_or(default)
    }

    /// Reads any text.
    pub(crate) fn text(&mut self, key: &'static str) -> Option<Spanned<String>> {
        let value = self.value(key)?;
        let text = value.get_ref().as_str();
        if text.is_none() {
            self.refuse(key, value, "must be a quoted string");
        }
        text.map(|text| Spanned::new(value.span(), text.to_owned()))
    }

    /// Reads the address of a page on the web.
    pub(crate) fn link(&mut self, key: &'static str) -> Option<Spanned<String>> {
        let value = self.value(key)?;
        let is_link = |text: &&str| {
            let rest = ["https://", "http://"].map(|scheme| text.strip_prefix(scheme));
            let rest = rest.into_iter().flatten().next().unwrap_or_default();
            !rest.is_empty() && !rest.contains(|c: char| c.is_whitespace() || c.is_control())
        };
        let text = value.get_ref().as_str().filter(is_link);
        if text.is_none() {
            let allowed = "must be an address that begins with https:// or http://";
            self.refuse(key, value, allowed);
        }
        text.map(|text| Spanned::new(value.span(), text.to_owned()))
    }

    /// Reads a name that can be one chunk of a key expression.
    pub(crate) fn name(&mut self, key: &'static str) -> Option<Spanned<String>> {
        let value = self.value(key)?;
        self.check_name(key, value)
    }

    /// Reads a required name.
    pub(crate) fn required_name(&mut self, key: &'static str) -> Option<Spanned<String>> {
        let value = self.name(key);
        self.require(key, NAME_RULE, value)
    }

    fn check_name(&self, key: &str, value: &Spanned<DeValue<'t>>) -> Option<Spanned<String>> {
        match value.get_ref().as_str() {
            Some(name) if is_name(name) => Some(Spanned::new(value.span(), name.to_owned())),
            _ => {
                self.refuse(key, value, NAME_RULE);
                None
            }
        }
    }

    /// Reads a list of names; reports and omits wrong names.
    pub(crate) fn names(&mut self, key: &'static str) -> Option<Spanned<Vec<Spanned<String>>>> {
        let value = self.value(key)?;
        let Some(entries) = value.get_ref().as_array() else {
            self.refuse(key, value, "must be a list of names");
            return None;
        };
        let names = entries
            .iter()
            .filter_map(|entry| self.check_name(key, entry))
            .collect();
        Some(Spanned::new(value.span(), names))
    }

    /// Reads a list of lists of names; reports and omits wrong names.
    pub(crate) fn name_lists(
        &mut self,
        key: &'static str,
    ) -> Option<Vec<Spanned<Vec<Spanned<String>>>>> {
        let value = self.value(key)?;
        let allowed = "must be a list of lists of names";
        let Some(lists) = value.get_ref().as_array() else {
            self.refuse(key, value, allowed);
            return None;
        };
        let read = |list: &'t Spanned<DeValue<'t>>| match list.get_ref().as_array() {
            Some(entries) => {
                let names = entries
                    .iter()
                    .filter_map(|entry| self.check_name(key, entry))
                    .collect();
                Some(Spanned::new(list.span(), names))
            }
            None => {
                self.refuse(key, list, allowed);
                None
            }
        };
        lists.iter().map(read).collect()
    }

    /// Reads a word from a closed set.
    pub(crate) fn choice<T: Copy>(
        &mut self,
        key: &'static str,
        choices: &[(&str, T)],
    ) -> Option<Spanned<T>> {
        let value = self.value(key)?;
        let chosen = value
            .get_ref()
            .as_str()
            .and_then(|word| choices.iter().find(|(name, _)| *name == word));
        if chosen.is_none() {
            self.refuse(key, value, choice_rule(choices));
        }
        chosen.map(|(_, choice)| Spanned::new(value.span(), *choice))
    }

    /// Reads a required word from a closed set.
    pub(crate) fn required_choice<T: Copy>(
        &mut self,
        key: &'static str,
        choices: &[(&str, T)],
    ) -> Option<Spanned<T>> {
        let chosen = self.choice(key, choices);
        self.require(key, choice_rule(choices), chosen)
    }

    /// Reads a number from 1, or a name.
    pub(crate) fn number_or_name(&mut self, key: &'static str) -> Option<Spanned<NumberOrName>> {
        let value = self.value(key)?;
        self.check_number_or_name(key, value, "degree of freedom")
    }

    /// Reads a list of numbers from 1 or names; `None` if an entry is neither.
    pub(crate) fn numbers_or_names(
        &mut self,
        key: &'static str,
    ) -> Option<Spanned<Vec<Spanned<NumberOrName>>>> {
        let value = self.value(key)?;
        self.check_numbers_or_names(key, value, "degree of freedom")
    }

    /// Reads a list of nodes by number or name; `None` if an entry is neither.
    pub(crate) fn nodes(
        &mut self,
        key: &'static str,
    ) -> Option<Spanned<Vec<Spanned<NumberOrName>>>> {
        let value = self.value(key)?;
        self.check_numbers_or_names(key, value, "node")
    }

    /// Reads a list of lists of nodes; `None` if an entry is not a list of nodes.
    pub(crate) fn paths(
        &mut self,
        key: &'static str,
    ) -> Option<Vec<Spanned<Vec<Spanned<NumberOrName>>>>> {
        let value = self.value(key)?;
        let Some(entries) = value.get_ref().as_array() else {
            self.refuse(key, value, "must be a list of lists of nodes");
            return None;
        };
        let all: Vec<_> = entries
            .iter()
            .map(|entry| self.check_numbers_or_names(key, entry, "node"))
            .collect();
        all.into_iter().collect()
    }

    fn check_numbers_or_names(
        &self,
        key: &str,
        value: &Spanned<DeValue<'t>>,
        of: &str,
    ) -> Option<Spanned<Vec<Spanned<NumberOrName>>>> {
        let Some(entries) = value.get_ref().as_array() else {
            self.refuse(
                key,
                value,
                format!("must be a list with the number or the name of each {of}"),
            );
            return None;
        };
        let all: Vec<_> = entries
            .iter()
            .map(|entry| self.check_number_or_name(key, entry, of))
            .collect();
        let all: Option<Vec<_>> = all.into_iter().collect();
        all.map(|all| Spanned::new(value.span(), all))
    }

    fn check_number_or_name(
        &self,
        key: &str,
        value: &Spanned<DeValue<'t>>,
        of: &str,
    ) -> Option<Spanned<NumberOrName>> {
        let name = value
            .get_ref()
            .as_str()
            .map(|name| NumberOrName::Name(name.to_owned()));
        let read = name.or_else(|| whole_number(value.get_ref()).map(NumberOrName::Number));
        if read.is_none() {
            self.refuse(
                key,
                value,
                format!("must be the number or the name of a {of}"),
            );
        }
        read.map(|read| Spanned::new(value.span(), read))
    }

    /// Returns `true` if the value of `key` is a text. Some keys allow a word or a table.
    pub(crate) fn is_text(&self, key: &str) -> bool {
        self.table
            .get(key)
            .is_some_and(|value| value.get_ref().is_str())
    }

    /// Opens a subtable.
    pub(crate) fn table(&mut self, key: &'static str) -> Option<Section<'t>> {
        let value = self.value(key)?;
        self.open(key, value)
    }

    /// Opens a required subtable.
    pub(crate) fn required_table(&mut self, key: &'static str) -> Option<Section<'t>> {
        let table = self.table(key);
        self.require(key, "must be given as a table", table)
    }

    /// Opens every table of a list of tables; a missing list counts as empty.
    pub(crate) fn tables(&mut self, key: &'static str) -> Vec<Section<'t>> {
        let Some(value) = self.value(key) else {
            return Vec::new();
        };
        match value.get_ref().as_array() {
            Some(entries) => entries
                .iter()
                .filter_map(|entry| self.open(key, entry))
                .collect(),
            None => {
                self.refuse(
                    key,
                    value,
                    format!("must be a list of tables: [[{}]]", self.key(key)),
                );
                Vec::new()
            }
        }
    }

    /// Opens a table with user-defined keys; returns its entries in file order.
    pub(crate) fn entries(
        &mut self,
        key: &'static str,
    ) -> Vec<(Spanned<String>, &'t Spanned<DeValue<'t>>)> {
        let Some(section) = self.table(key) else {
            return Vec::new();
        };
        let mut entries: Vec<_> = section.table.iter().collect();
        entries.sort_by_key(|(name, _)| name.span().start);
        entries
            .into_iter()
            .map(|(name, value)| (Spanned::new(name.span(), name.get_ref().to_string()), value))
            .collect()
    }

    /// Opens `value`, which belongs to `key` of this table, as a table.
    pub(crate) fn open(&self, key: &str, value: &'t Spanned<DeValue<'t>>) -> Option<Section<'t>> {
        match value.get_ref().as_table() {
            Some(table) => Some(Section::new(
                table,
                self.key(key),
                value.span(),
                self.diagnostics,
            )),
            None => {
                self.refuse(key, value, "must be a table");
                None
            }
        }
    }
}

/// Allowed names. A name becomes one chunk of a key expression.
const NAME_RULE: &str = "must be a name of 1 to 64 lower-case letters, digits and hyphens";

/// Maximum length of a name (bytes); every message contains the key expression.
const LONGEST_NAME: usize = 64;

/// Returns `true` if `name` can be one chunk of a key expression: `[a-z0-9-]{1,64}`.
pub(crate) fn is_name(name: &str) -> bool {
    (1..=LONGEST_NAME).contains(&name.len())
        && name
            .bytes()
            .all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-')
}

fn choice_rule<T>(choices: &[(&str, T)]) -> String {
    let words: Vec<String> = choices
        .iter()
        .map(|(word, _)| format!("\"{word}\""))
        .collect();
    match words.as_slice() {
        [one] => format!("must be {one}"),
        _ => format!("must be one of {}", words.join(", ")),
    }
}

fn whole_number(value: &DeValue<'_>) -> Option<i64> {
    let integer = value.as_integer()?;
    i64::from_str_radix(integer.as_str(), integer.radix()).ok()
}

/// Describes a value for a message.
pub(crate) fn describe(value: &DeValue<'_>) -> String {
    match value {
        DeValue::String(text) => format!("is \"{text}\""),
        DeValue::Integer(integer) => format!("is {integer}"),
        DeValue::Float(float) => format!("is {float}"),
        DeValue::Boolean(flag) => format!("is {flag}"),
        DeValue::Datetime(time) => format!("is the time {time}"),
        DeValue::Array(_) => "is a list".to_owned(),
        DeValue::Table(_) => "is a table".to_owned(),
    }
}
