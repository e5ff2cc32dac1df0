//! Bounded storage of one quantity over time: recent points individually, older points combined.

use std::collections::VecDeque;

/// Number of points kept individually, ten minutes at 10 Hz.
const FINE_KEPT: usize = 6_000;
/// Number of points that are combined into one for longer storage.
const COMBINED: usize = 10;
/// Number of combined points kept, 100 minutes at 10 Hz.
const COARSE_KEPT: usize = 6_000;

/// Maximum distance before the last point (ns) at which a point counts as a repetition.
///
/// After a crash, identify publishes some points again. A standby that takes over does the same.
const AGAIN_NS: i64 = 10_000_000_000;

/// How several values of one column are combined.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Combine {
    /// The newest value.
    Last,
    /// The minimum, for lower bounds.
    Least,
    /// The maximum, for upper bounds.
    Largest,
    /// The sum, for counts.
    Sum,
}

/// One quantity over time, with one column per entry of `combine`.
#[derive(Clone, Debug)]
pub(crate) struct Series {
    combine: &'static [Combine],
    fine: Table,
    coarse: Table,
    waiting: Table,
    pushed: u64,
    generation: u64,
}

/// Rows of a time (ns since the Unix epoch, UTC) and values.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Table {
    width: usize,
    times_ns: VecDeque<i64>,
    values: VecDeque<f64>,
}

impl Series {
    pub(crate) fn new(combine: &'static [Combine]) -> Self {
        let table = Table {
            width: combine.len(),
            ..Table::default()
        };
        Self {
            combine,
            fine: table.clone(),
            coarse: table.clone(),
            waiting: table,
            pushed: 0,
            generation: 0,
        }
    }

    /// Adds a point.
    ///
    /// A point well before the last one starts a new run of measurement and clears the series. A
    /// point just before the last one is a repetition and is skipped.
    pub(crate) fn push(&mut self, time_ns: i64, values: &[f64]) {
        match self.fine.times_ns.back() {
            Some(last) if time_ns < last.saturating_sub(AGAIN_NS) => {
                self.fine.clear();
                self.coarse.clear();
                self.waiting.clear();
                self.generation += 1;
            }
            Some(last) if time_ns <= *last => return,
            Some(_) | None => {}
        }
        self.pushed += 1;
        self.fine.push(time_ns, values);
        self.fine.keep(FINE_KEPT);
        self.waiting.push(time_ns, values);
        if self.waiting.len() == COMBINED {
            self.waiting
                .combine_into(&mut self.coarse, 0..COMBINED, self.combine);
            self.waiting.clear();
            self.coarse.keep(COARSE_KEPT);
        }
    }

    /// Returns the number of points added so far.
    pub(crate) fn pushed(&self) -> u64 {
        self.pushed
    }

    /// Returns the number of times that time has jumped back.
    pub(crate) fn generation(&self) -> u64 {
        self.generation
    }

    /// Returns the time of the oldest stored point.
    pub(crate) fn first_ns(&self) -> Option<i64> {
        let firsts = [self.coarse.times_ns.front(), self.fine.times_ns.front()];
        firsts.into_iter().flatten().min().copied()
    }

    /// Returns the stored points after the first `pushed` ones, combined to at most `most`.
    pub(crate) fn since(&self, pushed: u64, most: usize) -> Table {
        let new = usize::try_from(self.pushed.saturating_sub(pushed))
            .unwrap_or(usize::MAX)
            .min(self.fine.len());
        self.fine
            .combined(self.fine.len() - new..self.fine.len(), most, self.combine)
    }

    /// Returns the points from one time to another, both inclusive, combined to at most `most`.
    ///
    /// Older and recent points are combined to the same distance in time. Otherwise, plots would
    /// take the longer distance of the older points for gaps.
    pub(crate) fn span(&self, from_ns: i64, to_ns: i64, most: usize) -> Table {
        let fine_from = self.fine.times_ns.front().copied().unwrap_or(i64::MAX);
        let before_fine = to_ns.min(fine_from.saturating_sub(1));
        let older = self.coarse.within(from_ns, before_fine);
        let newer = self.fine.within(from_ns, to_ns);
        if older.is_empty() || older.len() + newer.len() <= most {
            let mut all = self.coarse.combined(older, usize::MAX, self.combine);
            all.append(self.fine.combined(newer, most, self.combine));
            return all;
        }
        let rows = |each: usize| older.len().div_ceil(each) + newer.len().div_ceil(each * COMBINED);
        let all = older.len() + newer.len();
        let fewest = all.div_ceil(COMBINED * most.max(1)).max(1);
        let each = (fewest..all)
            .find(|each| rows(*each) <= most)
            .unwrap_or(all);
        let mut table = self.coarse.combined_by(older, each, self.combine);
        let newer = self.fine.combined_by(newer, each * COMBINED, self.combine);
        table.append(newer);
        table.combined(0..table.len(), most, self.combine)
    }
}

impl Table {
    /// Returns the number of rows.
    pub(crate) fn len(&self) -> usize {
        self.times_ns.len()
    }

    /// Returns the times of the rows (ns since the Unix epoch, UTC).
    pub(crate) fn times_ns(&self) -> impl Iterator<Item = i64> {
        self.times_ns.iter().copied()
    }

    /// Returns the values of one column.
    pub(crate) fn column(&self, column: usize) -> impl Iterator<Item = f64> {
        self.values
            .iter()
            .skip(column)
            .step_by(self.width.max(1))
            .copied()
    }

    /// Returns the values of one row.
    pub(crate) fn row(&self, row: usize) -> impl Iterator<Item = f64> {
        self.values
            .range(row * self.width..(row + 1) * self.width)
            .copied()
    }

    /// Creates a table from rows of `width` values each.
    pub(crate) fn of(width: usize, rows: impl Iterator<Item = (i64, Vec<f64>)>) -> Self {
        let mut table = Self {
            width,
            ..Self::default()
        };
        rows.for_each(|(time_ns, values)| table.push(time_ns, &values));
        table
    }

    /// Appends the rows of another table of the same width.
    pub(crate) fn append(&mut self, mut other: Self) {
        self.times_ns.append(&mut other.times_ns);
        self.values.append(&mut other.values);
    }

    fn push(&mut self, time_ns: i64, values: &[f64]) {
        self.times_ns.push_back(time_ns);
        // A row of another width would shift all following rows.
        let filled = values.iter().copied().chain(std::iter::repeat(f64::NAN));
        self.values.extend(filled.take(self.width));
    }

    fn keep(&mut self, most: usize) {
        while self.len() > most {
            self.times_ns.pop_front();
            self.values.drain(..self.width);
        }
    }

    fn clear(&mut self) {
        self.times_ns.clear();
        self.values.clear();
    }

    /// Returns the indices of the rows from one time to another, both inclusive.
    fn within(&self, from_ns: i64, to_ns: i64) -> std::ops::Range<usize> {
        let from = self.times_ns.partition_point(|time| *time < from_ns);
        let to = self.times_ns.partition_point(|time| *time <= to_ns);
        from..to.max(from)
    }

    /// Combines neighbouring rows until at most `most` remain.
    fn combined(&self, rows: std::ops::Range<usize>, most: usize, combine: &[Combine]) -> Self {
        let each = rows.len().div_ceil(most.max(1)).max(1);
        self.combined_by(rows, each, combine)
    }

    /// Combines each `each` neighbouring rows.
    fn combined_by(&self, rows: std::ops::Range<usize>, each: usize, combine: &[Combine]) -> Self {
        let mut out = Self {
            width: self.width,
            ..Self::default()
        };
        let mut start = rows.start;
        while start < rows.end {
            let end = (start + each).min(rows.end);
            self.combine_into(&mut out, start..end, combine);
            start = end;
        }
        out
    }

    /// Combines several rows into one row of `out`, at the time of the last one.
    fn combine_into(&self, out: &mut Self, rows: std::ops::Range<usize>, combine: &[Combine]) {
        let Some(last) = rows.clone().last() else {
            return;
        };
        out.times_ns.push_back(self.times_ns[last]);
        for (column, combine) in combine.iter().enumerate() {
            let values = rows
                .clone()
                .map(|row| self.values[row * self.width + column]);
            out.values.push_back(match combine {
                Combine::Last => self.values[last * self.width + column],
                // `min` and `max` ignore NaN, which marks a missing value.
                Combine::Least => values.fold(f64::NAN, f64::min),
                Combine::Largest => values.fold(f64::NAN, f64::max),
                Combine::Sum => values.sum(),
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RANGE: &[Combine] = &[Combine::Least, Combine::Largest];

    fn ramp(points: i64) -> Series {
        let mut series = Series::new(&[Combine::Last, Combine::Sum]);
        (0..points).for_each(|time| series.push(time, &[time as f64, 1.0]));
        series
    }

    #[test]
    fn series_keeps_at_most_its_limit() {
        let series = ramp(1_000_000);
        assert_eq!(
            (series.fine.len(), series.coarse.len()),
            (FINE_KEPT, COARSE_KEPT)
        );
        assert!(series.waiting.len() < COMBINED);
        assert_eq!(series.values_kept(), 2 * (FINE_KEPT + COARSE_KEPT));
    }

    impl Series {
        fn values_kept(&self) -> usize {
            self.fine.values.len() + self.coarse.values.len() + self.waiting.values.len()
        }
    }

    #[test]
    fn combined_and_fine_points_do_not_overlap() {
        let series = ramp(20_000);
        let table = series.span(0, i64::MAX, usize::MAX);
        let times: Vec<i64> = table.times_ns().collect();
        assert!(times.is_sorted_by(|a, b| a < b));
        assert_eq!((times[0], times[1]), (9, 19));
        assert_eq!(times.len(), 1_400 + FINE_KEPT);
        // No point is counted twice, and only points not yet combined are missing.
        assert_eq!(table.column(1).sum::<f64>(), 20_000.0);
    }

    /// Regression test: the distance of older points was ten times that of recent ones, so that
    /// plots showed them as gaps.
    #[test]
    fn points_of_a_span_have_the_same_distance() {
        let series = ramp(20_000);
        for most in [2, 10, 400, 1_000, 3_000] {
            let table = series.span(0, i64::MAX, most);
            let times: Vec<i64> = table.times_ns().collect();
            assert!(times.len() <= most, "{} points of {most}", times.len());
            assert_eq!(table.column(1).sum::<f64>(), 20_000.0);
            let steps: Vec<i64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
            let (least, largest) = (steps.iter().min().unwrap(), steps.iter().max().unwrap());
            // The last row of each part may be shorter.
            let usual = steps[0];
            let short = steps.iter().filter(|step| **step < usual).count();
            assert!(short <= 2 && *largest == usual, "{least} to {largest}");
        }
    }

    #[test]
    fn combined_points_keep_the_extremes() {
        let mut series = Series::new(RANGE);
        for time in 0..1_000 {
            let spike = if time == 123 { 50.0 } else { 1.0 };
            series.push(time, &[-1.0, spike]);
        }
        let table = series.span(0, 999, 10);
        assert_eq!(table.len(), 10);
        assert_eq!(table.column(1).fold(0.0, f64::max), 50.0);
        assert_eq!(table.column(0).fold(0.0, f64::min), -1.0);
    }

    #[test]
    fn numbers_replace_missing_values_in_combined_points() {
        let mut series = Series::new(RANGE);
        series.push(0, &[f64::NAN, f64::NAN]);
        series.push(1, &[-2.0, 3.0]);
        let table = series.since(0, 1);
        assert_eq!(table.row(0).collect::<Vec<_>>(), [-2.0, 3.0]);
    }

    #[test]
    fn new_points_are_returned_once() {
        let mut series = ramp(100);
        let seen = series.pushed();
        assert_eq!(series.since(seen, 10).len(), 0);
        series.push(100, &[7.0, 1.0]);
        assert_eq!(series.since(seen, 10).times_ns().collect::<Vec<_>>(), [100]);
    }

    #[test]
    fn time_going_back_starts_a_new_series() {
        let mut series = ramp(500);
        let last = 499 + 2 * AGAIN_NS;
        series.push(last, &[0.0, 1.0]);
        series.push(last - AGAIN_NS - 1, &[0.0, 1.0]);
        assert_eq!(
            (series.generation(), series.first_ns(), series.fine.len()),
            (1, Some(499 + AGAIN_NS - 1), 1)
        );
    }

    /// Regression test: a second that was published again cleared all plots.
    #[test]
    fn repeated_points_change_nothing() {
        let mut series = ramp(500);
        series.push(3, &[0.0, 1.0]);
        series.push(499, &[0.0, 1.0]);
        assert_eq!(
            (series.generation(), series.first_ns(), series.fine.len()),
            (0, Some(0), 500)
        );
        series.push(500, &[0.0, 1.0]);
        assert_eq!(series.fine.len(), 501);
    }
}
