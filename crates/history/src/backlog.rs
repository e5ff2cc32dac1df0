//! A bounded queue of rows while the database is unavailable. It counts dropped rows.

use crate::batch::Batch;
use std::collections::VecDeque;
use std::sync::Arc;

/// Maximum number of rows in the queue: about 100 MB, or a quarter of an hour of fifty parameters.
const MOST_ROWS: usize = 500_000;

/// Batches in order of arrival.
#[derive(Debug)]
pub(crate) struct Backlog {
    batches: VecDeque<Arc<Batch>>,
    rows: usize,
    most_rows: usize,
    /// Number of dropped display values. Their minute, hour and day still include them.
    pub(crate) dropped_points: u64,
    /// Number of dropped minutes, hours, days, alerts and events.
    pub(crate) dropped_rows: u64,
}

impl Default for Backlog {
    fn default() -> Self {
        Self::new(MOST_ROWS)
    }
}

impl Backlog {
    pub(crate) fn new(most_rows: usize) -> Self {
        Self {
            batches: VecDeque::new(),
            rows: 0,
            most_rows,
            dropped_points: 0,
            dropped_rows: 0,
        }
    }

    /// Returns the number of rows in the queue.
    pub(crate) fn rows(&self) -> usize {
        self.rows
    }

    /// Adds a batch. When the queue is full, the oldest values are dropped first, then the oldest
    /// batches.
    pub(crate) fn push(&mut self, batch: Batch) {
        self.rows += batch.rows();
        self.batches.push_back(Arc::new(batch));
        let mut place = 0;
        while self.rows > self.most_rows && place < self.batches.len() {
            let batch = Arc::make_mut(&mut self.batches[place]);
            let points = std::mem::take(&mut batch.points).len();
            self.rows -= points;
            self.dropped_points += points as u64;
            place += 1;
        }
        while self.rows > self.most_rows {
            let Some(batch) = self.batches.pop_front() else {
                return;
            };
            self.rows -= batch.rows();
            self.dropped_rows += batch.rows() as u64;
        }
    }

    /// Returns the oldest batches, up to about `rows` rows. At least one if there is any.
    pub(crate) fn oldest(&self, rows: usize) -> Vec<Arc<Batch>> {
        let mut found = Vec::new();
        let mut sum = 0;
        for batch in &self.batches {
            found.push(batch.clone());
            sum += batch.rows();
            if sum >= rows {
                break;
            }
        }
        found
    }

    /// Removes the batches up to this number, which the database has stored.
    pub(crate) fn written(&mut self, number: i64) {
        while let Some(batch) = self.batches.front().filter(|batch| batch.number <= number) {
            self.rows -= batch.rows();
            self.batches.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::batch::{Kind, Series};
    use crate::sums::Sums;
    use std::collections::BTreeMap;

    /// Returns a batch of ten values with the minute that contains them.
    fn batch(number: i64) -> Batch {
        let series = Series {
            kind: Kind::Parameter,
            name: "storey-1".to_owned(),
        };
        let points = (0..10)
            .map(|k| (series.clone(), number * 10 + k, [1.0, 0.1, 0.0]))
            .collect();
        let buckets = BTreeMap::from([((series, 60, number), Sums::of(number, [1.0, 0.1, 0.0]))]);
        Batch {
            structure: "spandrel/tower".to_owned(),
            number,
            points,
            repeatable: Vec::new(),
            buckets,
            happened: Vec::new(),
        }
    }

    #[test]
    fn backlog_is_bounded_and_dropped_rows_are_counted() {
        let mut backlog = Backlog::new(100);
        (1..=1_000).for_each(|number| backlog.push(batch(number)));
        assert!(backlog.rows() <= 100);
        let kept: usize = backlog
            .oldest(usize::MAX)
            .iter()
            .map(|batch| batch.rows())
            .sum();
        assert_eq!(kept, backlog.rows());
        assert_eq!(
            kept as u64 + backlog.dropped_points + backlog.dropped_rows,
            11_000
        );
        // Values are dropped before the minutes that include them.
        assert!(backlog.dropped_rows < backlog.dropped_points / 9);
        assert_eq!(
            backlog.oldest(usize::MAX).last().map(|batch| batch.number),
            Some(1_000)
        );
    }

    #[test]
    fn written_batches_are_removed_in_order() {
        let mut backlog = Backlog::new(1_000);
        (1..=5).for_each(|number| backlog.push(batch(number)));
        assert_eq!(backlog.oldest(1).len(), 1);
        assert_eq!(backlog.oldest(12).len(), 2);
        backlog.written(3);
        assert_eq!(
            backlog
                .oldest(usize::MAX)
                .iter()
                .map(|batch| batch.number)
                .collect::<Vec<_>>(),
            [4, 5]
        );
        assert_eq!(backlog.rows(), 22);
    }
}
