//! The present values of the conditions of a structure.

use crate::store::Store;
use serde::Serialize;

/// A condition and its latest value.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct ConditionView<'s> {
    pub(crate) name: &'s str,
    pub(crate) unit: &'static str,
    /// Latest value (unit). `None` before the first message.
    pub(crate) value: Option<f64>,
    /// Measurement time of the value (s since the Unix epoch, UTC).
    pub(crate) time_s: Option<f64>,
    /// Age of the value (s).
    pub(crate) age_s: Option<f64>,
    /// Whether the next value is overdue.
    pub(crate) stale: bool,
    /// Whether the value is not plausible by the structure file.
    pub(crate) implausible: bool,
    /// Label of the instrument.
    pub(crate) instrument: Option<&'s str>,
}

/// Returns the conditions in the order of the structure file.
pub(crate) fn conditions(store: &Store) -> impl Iterator<Item = ConditionView<'_>> {
    store.about.conditions.iter().map(|about| {
        let latest = store.state.conditions.get(about.name.as_str());
        let display = latest.map(|latest| &latest.display);
        let value = display.map(|display| display.value);
        let now = store.state.now();
        let is_outside =
            |(low, high): (f64, f64)| value.is_some_and(|value| !(low..=high).contains(&value));
        ConditionView {
            name: &about.name,
            unit: about.unit,
            value,
            time_s: display.map(|display| display.time_ns as f64 / 1e9),
            age_s: latest.map(|latest| latest.age(now).as_secs_f64()),
            stale: latest.is_some_and(|latest| latest.is_stale(now)),
            implausible: about.range.is_some_and(is_outside),
            instrument: display.and_then(|display| display.instrument.as_deref()),
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{air, at, demo_with_air};
    use spandrel_listener::Input;

    #[test]
    fn a_condition_is_stale_after_two_intervals() {
        let mut store = demo_with_air();
        let of = |store: &Store| {
            conditions(store)
                .next()
                .map(|view| (view.value, view.stale))
        };
        assert_eq!(of(&store), Some((None, false)));
        store.handle(at(5.0));
        store.handle(Input::Condition(air(5, 21.5)));
        assert_eq!(of(&store), Some((Some(21.5), false)));
        store.handle(at(25.0));
        assert_eq!(of(&store), Some((Some(21.5), false)));
        store.handle(at(25.1));
        assert_eq!(of(&store), Some((Some(21.5), true)));
    }

    #[test]
    fn an_implausible_value_says_so_and_another_unit_is_ignored() {
        let mut store = demo_with_air();
        store.handle(Input::Condition(air(5, 61.0)));
        assert!(conditions(&store).all(|view| view.implausible));
        let mut kelvin = air(6, 293.0);
        kelvin.unit = "K".to_owned();
        store.handle(Input::Condition(kelvin));
        assert_eq!(
            conditions(&store).next().and_then(|view| view.value),
            Some(61.0)
        );
    }
}
