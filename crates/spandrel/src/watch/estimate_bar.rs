//! An estimate with its interval as a bar, and its last minutes as a row of blocks on the same
//! axis.

use spandrel_bus::{LossDisplay, ParameterDisplay};

/// Limits of the axis (ratios to nominal). Beyond them, only the number is meaningful.
const FURTHEST: (f64, f64) = (0.0, 2.0);
/// The ends of the axis are multiples of this value, so that the axis does not move with each
/// value.
const GRID: f64 = 0.05;
/// Margin beyond the outermost value.
const MARGIN: f64 = 0.01;

const MEAN: char = '●';
const INTERVAL: char = '━';
const LIMIT: char = '┊';
const LIMIT_IN_INTERVAL: char = '╋';
const REFERENCE: char = '│';
const LEVELS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];

/// Range of ratios that the bars and trends of one structure share.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Axis {
    low: f64,
    high: f64,
}

/// Positions of the parts of a bar (ratios to nominal).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Marks {
    mean: f64,
    interval: (f64, f64),
    /// Ratio below which the loss exceeds the threshold of the alert rule. `None` before the
    /// reference is known, and without a rule.
    limit: Option<f64>,
    reference: Option<f64>,
}

impl Marks {
    /// Creates the marks of a parameter and its loss.
    pub fn new(display: &ParameterDisplay, loss: Option<&LossDisplay>) -> Self {
        Self {
            mean: display.mean,
            interval: (display.interval.low, display.interval.high),
            limit: loss.map(|loss| (1.0 - loss.rule_loss) * loss.reference),
            reference: loss.map(|loss| loss.reference),
        }
    }

    /// Returns the values that the axis must include.
    pub fn extent(self) -> impl Iterator<Item = f64> {
        let of_loss = self.limit.into_iter().chain(self.reference);
        [self.interval.0, self.interval.1]
            .into_iter()
            .chain(of_loss)
    }
}

impl Axis {
    /// Returns the axis that includes `values`. Its ends are on the grid, and it is never empty.
    pub fn around(values: impl Iterator<Item = f64>) -> Self {
        let (least, most) = FURTHEST;
        let within = |value: f64| value.clamp(least, most);
        let (low, high) = values.fold((1.0_f64, 1.0_f64), |(low, high), value| {
            (low.min(within(value)), high.max(within(value)))
        });
        Self {
            low: ((low - MARGIN) / GRID).floor() * GRID,
            high: ((high + MARGIN) / GRID).ceil() * GRID,
        }
    }

    /// Returns the ends as text.
    pub fn labels(self) -> (String, String) {
        (format!("{:.2}", self.low), format!("{:.2}", self.high))
    }

    /// Returns the position of a value on the axis, from 0 to 1.
    fn fraction(self, value: f64) -> f64 {
        ((value - self.low) / (self.high - self.low)).clamp(0.0, 1.0)
    }

    /// Returns the index of a value's cell among `width` cells.
    fn cell(self, value: f64, width: usize) -> usize {
        ((self.fraction(value) * width as f64) as usize).min(width.saturating_sub(1))
    }

    /// Draws an estimate with `width` characters.
    pub fn bar(self, width: usize, marks: &Marks) -> String {
        if width == 0 {
            return String::new();
        }
        let mut cells = vec![' '; width];
        let limit = marks.limit.map(|limit| self.cell(limit, width));
        if let Some(reference) = marks.reference {
            cells[self.cell(reference, width)] = REFERENCE;
        }
        if let Some(limit) = limit {
            cells[limit] = LIMIT;
        }
        let (low, high) = (
            self.cell(marks.interval.0, width),
            self.cell(marks.interval.1, width),
        );
        for (at, cell) in cells.iter_mut().enumerate().take(high + 1).skip(low) {
            *cell = if Some(at) == limit {
                LIMIT_IN_INTERVAL
            } else {
                INTERVAL
            };
        }
        cells[self.cell(marks.mean, width)] = MEAN;
        cells.into_iter().collect()
    }

    /// Draws values with `width` characters, the newest at the right.
    pub fn trend(self, width: usize, values: impl Iterator<Item = Option<f64>>) -> String {
        let block = |value: f64| {
            LEVELS[((self.fraction(value) * LEVELS.len() as f64) as usize).min(LEVELS.len() - 1)]
        };
        let blocks: String = values.map(|value| value.map_or(' ', block)).collect();
        format!("{blocks:>width$}")
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{loss, parameter};
    use super::*;

    fn marks(mean: f64, half_width: f64) -> Marks {
        Marks {
            mean,
            interval: (mean - half_width, mean + half_width),
            limit: Some(0.945),
            reference: Some(1.005),
        }
    }

    const AXIS: Axis = Axis {
        low: 0.8,
        high: 1.2,
    };

    #[test]
    fn bar_shows_mean_interval_limit_and_reference_at_their_positions() {
        // 40 cells of 0.01: mean 0.905 in cell 10, interval in 7 to 13, limit 0.945 in 14,
        // reference 1.005 in 20.
        let expected = format!("{}━━━●━━━┊     │{}", " ".repeat(7), " ".repeat(19));
        assert_eq!(AXIS.bar(40, &marks(0.905, 0.03)), expected);
    }

    #[test]
    fn limit_is_visible_within_the_interval() {
        let bar = AXIS.bar(40, &marks(0.975, 0.04));
        assert!(bar.contains("━╋━━●━━━━"), "{bar}");
    }

    #[test]
    fn an_interval_narrower_than_a_cell_is_its_mean() {
        assert_eq!(AXIS.bar(4, &marks(1.05, 0.001)), " ┊● ");
    }

    #[test]
    fn axis_holds_all_values_on_its_grid_and_stays_in_bounds() {
        assert_eq!(
            Axis::around([0.86, 1.03].into_iter()).labels(),
            ("0.85".to_owned(), "1.05".to_owned())
        );
        assert_eq!(
            Axis::around(std::iter::empty()).labels(),
            ("0.95".to_owned(), "1.05".to_owned())
        );
        assert_eq!(
            Axis::around([-1e300, 1e300].into_iter()).labels(),
            ("-0.05".to_owned(), "2.05".to_owned())
        );
    }

    #[test]
    fn bar_has_the_given_width_for_any_values() {
        for width in [0, 1, 2, 7] {
            for mean in [-1e300, 0.0, 1e300] {
                assert_eq!(AXIS.bar(width, &marks(mean, 1e300)).chars().count(), width);
            }
        }
    }

    #[test]
    fn trend_follows_the_values_and_shows_gaps() {
        let values = [Some(1.19), Some(1.0), None, Some(0.81)];
        assert_eq!(AXIS.trend(6, values.into_iter()), "  █▅ ▁");
    }

    #[test]
    fn a_learnt_reference_moves_the_limit() {
        let display = parameter("storey-1", 0, 1.0, 0.01);
        let mut learnt = loss("storey-1", 0, 1.0);
        assert_eq!(Marks::new(&display, None).limit, None);
        assert_eq!(Marks::new(&display, Some(&learnt)).limit, Some(0.95));
        learnt.reference = 0.9;
        learnt.rule_loss = 0.1;
        let limit = Marks::new(&display, Some(&learnt)).limit.unwrap();
        assert!((limit - 0.81).abs() < 1e-12);
    }
}
