//! Rounding of probabilities for display.

use std::fmt;

/// Minimum and maximum number of decimals of a probability (0 to 1).
const DECIMALS: std::ops::RangeInclusive<i32> = 3..=6;

/// A probability rounded to three to six decimals, as a number from 0 to 1.
///
/// Three decimals suffice unless the rounded value would lie on the other side of a required
/// probability. The text never displays certainty, but `above 0.999` or `> 99.9 %`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RoundedProbability {
    bound: Bound,
    shown: f64,
    decimals: usize,
}

/// Relation of the probability to the displayed number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Bound {
    Nearest,
    Above,
    Below,
}

impl RoundedProbability {
    /// Rounds `value`, so that the result lies on the same side of each probability in `asked`. All
    /// probabilities are from 0 to 1.
    #[must_use]
    pub fn new(value: f64, asked: &[f64]) -> Self {
        let rounded = DECIMALS.map(|decimals| Self::to_decimals(value, decimals));
        let is_told = |rounded: &Self| asked.iter().all(|asked| rounded.tells(value, *asked));
        let mut all = rounded.filter(is_told);
        all.next().unwrap_or_else(|| Self::away_from(value, asked))
    }

    fn to_decimals(value: f64, decimals: i32) -> Self {
        let unit = 10f64.powi(-decimals);
        let (bound, shown) = if value >= 1.0 - unit / 2.0 {
            (Bound::Above, 1.0 - unit)
        } else if value < unit / 2.0 {
            (Bound::Below, unit)
        } else {
            (Bound::Nearest, value)
        };
        Self {
            bound,
            shown,
            decimals: decimals.unsigned_abs() as usize,
        }
        .as_printed()
    }

    /// Rounds to the maximum number of decimals, away from the nearby required probability.
    fn away_from(value: f64, asked: &[f64]) -> Self {
        let nearest = Self::to_decimals(value, *DECIMALS.end());
        let Some(missed) = asked.iter().find(|asked| !nearest.tells(value, **asked)) else {
            return nearest;
        };
        let units = 10f64.powi(*DECIMALS.end());
        let shown = if value >= *missed {
            (value * units).ceil()
        } else {
            (value * units).floor()
        } / units;
        Self {
            bound: Bound::Nearest,
            shown: shown.clamp(1.0 / units, 1.0 - 1.0 / units),
            ..nearest
        }
        .as_printed()
    }

    /// Replaces the number by the value of its text.
    fn as_printed(self) -> Self {
        let printed = format!("{:.*}", self.decimals, self.shown);
        Self {
            shown: printed.parse().unwrap_or(self.shown),
            ..self
        }
    }

    /// Returns `true` if the displayed number lies on the same side of `asked` as `value`.
    fn tells(&self, value: f64, asked: f64) -> bool {
        let (least, most) = match self.bound {
            Bound::Nearest => (self.shown, self.shown),
            Bound::Above => (self.shown, 1.0),
            Bound::Below => (0.0, self.shown),
        };
        if value >= asked {
            least >= asked
        } else {
            most < asked
        }
    }

    /// Returns the text in per cent: `1.2 %`, `> 99.9 %`.
    #[must_use]
    pub fn percent(&self) -> String {
        let sign = match self.bound {
            Bound::Nearest => "",
            Bound::Above => "> ",
            Bound::Below => "< ",
        };
        format!("{sign}{:.*} %", self.decimals - 2, 100.0 * self.shown)
    }
}

impl fmt::Display for RoundedProbability {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sign = match self.bound {
            Bound::Nearest => "",
            Bound::Above => "above ",
            Bound::Below => "below ",
        };
        write!(f, "{sign}{:.*}", self.decimals, self.shown)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn told(value: f64, asked: &[f64]) -> (String, String) {
        let rounded = RoundedProbability::new(value, asked);
        (rounded.to_string(), rounded.percent())
    }

    fn pair(share: &str, percent: &str) -> (String, String) {
        (share.to_owned(), percent.to_owned())
    }

    #[test]
    fn probabilities_are_never_shown_as_0_or_1() {
        assert_eq!(told(1.0, &[0.99]), pair("above 0.999", "> 99.9 %"));
        assert_eq!(told(0.998_4, &[0.99]), pair("0.998", "99.8 %"));
        assert_eq!(told(1e-9, &[0.99]), pair("below 0.001", "< 0.1 %"));
        assert_eq!(told(0.5, &[]), pair("0.500", "50.0 %"));
    }

    /// Regression test: 0.9899 was displayed as 0.990, next to the state normal of a rule that
    /// requires 0.99.
    #[test]
    fn displayed_probability_is_on_the_same_side_of_the_threshold() {
        assert_eq!(told(0.9899, &[0.99]), pair("0.9899", "98.99 %"));
        assert_eq!(told(0.989_96, &[0.5, 0.99]), pair("0.98996", "98.996 %"));
        assert_eq!(told(0.99, &[0.99]), pair("0.990", "99.0 %"));
        assert_eq!(told(0.949_7, &[0.949_6]), pair("0.950", "95.0 %"));
        assert_eq!(told(0.989_999_99, &[0.99]), pair("0.989999", "98.9999 %"));
        assert_eq!(
            told(0.500_000_1, &[0.500_000_05]),
            pair("0.500001", "50.0001 %")
        );
    }

    #[test]
    fn displayed_bounds_are_on_the_same_side_of_the_threshold() {
        assert_eq!(told(0.999_6, &[0.999_5]), pair("0.9996", "99.96 %"));
        assert_eq!(told(0.999_6, &[0.999_9]), pair("0.9996", "99.96 %"));
        assert_eq!(
            told(0.999_99, &[0.999_5]),
            pair("above 0.9999", "> 99.99 %")
        );
        assert_eq!(told(0.000_4, &[0.000_5]), pair("0.0004", "0.04 %"));
    }
}
