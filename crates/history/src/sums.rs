//! Aggregates of values, in sums that can be extended.

use spandrel_bus::{CredibleInterval, HistoryRows};

/// Sums over values of one quantity. Each value has a mean, a standard deviation and a probability
/// of loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Sums {
    /// Time of the first value (ns since the Unix epoch, UTC).
    pub(crate) first_ns: i64,
    /// Time of the last value (ns since the Unix epoch, UTC).
    pub(crate) last_ns: i64,
    pub(crate) count: i64,
    pub(crate) mean_sum: f64,
    pub(crate) square_sum: f64,
    pub(crate) variance_sum: f64,
    pub(crate) least: f64,
    pub(crate) largest: f64,
    pub(crate) low: f64,
    pub(crate) high: f64,
    pub(crate) probability: f64,
}

impl Sums {
    /// Returns the sums of one value.
    pub(crate) fn of(time_ns: i64, [mean, std, probability]: [f64; 3]) -> Self {
        Self {
            first_ns: time_ns,
            last_ns: time_ns,
            count: 1,
            mean_sum: mean,
            square_sum: mean * mean,
            variance_sum: std * std,
            least: mean,
            largest: mean,
            low: mean - CredibleInterval::HALF_WIDTH_95 * std,
            high: mean + CredibleInterval::HALF_WIDTH_95 * std,
            probability,
        }
    }

    /// Adds the sums of other values.
    pub(crate) fn add(&mut self, other: &Self) {
        self.first_ns = self.first_ns.min(other.first_ns);
        self.last_ns = self.last_ns.max(other.last_ns);
        self.count += other.count;
        self.mean_sum += other.mean_sum;
        self.square_sum += other.square_sum;
        self.variance_sum += other.variance_sum;
        self.least = self.least.min(other.least);
        self.largest = self.largest.max(other.largest);
        self.low = self.low.min(other.low);
        self.high = self.high.max(other.high);
        self.probability = self.probability.max(other.probability);
    }

    fn push_to(&self, rows: &mut HistoryRows) {
        let count = self.count.max(1) as f64;
        let mean = self.mean_sum / count;
        rows.time_s.push(self.last_ns as f64 / 1e9);
        rows.count.push(self.count.max(0).unsigned_abs());
        rows.mean.push(mean);
        rows.std.push((self.variance_sum / count).max(0.0).sqrt());
        // Rounding can make the difference of squares negative.
        rows.spread
            .push((self.square_sum / count - mean * mean).max(0.0).sqrt());
        rows.least.push(self.least);
        rows.largest.push(self.largest);
        rows.low.push(self.low);
        rows.high.push(self.high);
        rows.probability_of_loss.push(self.probability);
    }
}

/// Converts values to rows. Groups of adjacent values are combined until at most `most` rows
/// remain.
pub(crate) fn rows(values: &[Sums], most: usize) -> HistoryRows {
    let mut rows = HistoryRows::default();
    let each = values.len().div_ceil(most.max(1)).max(1);
    for group in values.chunks(each) {
        let mut sums = group[0];
        group[1..].iter().for_each(|other| sums.add(other));
        sums.push_to(&mut rows);
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_have_the_moments_and_extremes_of_their_values() {
        let values: Vec<Sums> = (0..4)
            .map(|k| {
                Sums::of(
                    i64::from(k) * 1_000_000_000,
                    [f64::from(k), 0.1 * f64::from(k), 0.2 * f64::from(k)],
                )
            })
            .collect();
        let rows = rows(&values, 1);
        assert_eq!((rows.time_s[0], rows.count[0], rows.mean[0]), (3.0, 4, 1.5));
        assert!((rows.std[0] - (0.01 * 14.0_f64 / 4.0).sqrt()).abs() < 1e-15);
        assert!((rows.spread[0] - 1.25_f64.sqrt()).abs() < 1e-15);
        assert_eq!((rows.least[0], rows.largest[0]), (0.0, 3.0));
        assert_eq!(
            rows.low[0],
            0.0_f64.min(1.0 - CredibleInterval::HALF_WIDTH_95 * 0.1)
        );
        assert!((rows.high[0] - (3.0 + CredibleInterval::HALF_WIDTH_95 * 0.3)).abs() < 1e-15);
        assert!((rows.probability_of_loss[0] - 0.6).abs() < 1e-15);
    }

    #[test]
    fn number_of_rows_is_at_most_the_requested_number() {
        let values: Vec<Sums> = (0..1_000).map(|k| Sums::of(k, [1.0, 0.1, 0.0])).collect();
        for most in [1, 2, 3, 7, 333, 999, 1_000, 5_000] {
            let rows = rows(&values, most);
            assert!(rows.time_s.len() <= most, "{most}: {}", rows.time_s.len());
            assert_eq!(rows.count.iter().sum::<u64>(), 1_000);
        }
        assert_eq!(rows(&[], 10), HistoryRows::default());
    }
}
