//! Replies of the history service.

use serde::{Deserialize, Serialize};

use super::{
    Acknowledgement, AlertMessage, Event, Format, MAX_ITEMS, Malformed, Message, check_count,
    check_finite_list, check_label,
};
use crate::name::Name;

/// History of one quantity, in rows that each summarise an interval. All columns have the same
/// length.
///
/// For a parameter, a row summarises the estimates of its interval:
///
/// - `mean`: average of their means
/// - `std`: square root of their average variance
/// - `spread`: standard deviation of their means
/// - `least`, `largest`: extremes of their means
/// - `low`, `high`: lowest and highest end of their 95 % intervals
///
/// The loss of a parameter has these columns too, and the largest `probability_of_loss`.
///
/// Other kinds have only a `mean`, or `mean` and `std`. Columns without values are zero.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct HistoryRows {
    /// Time of the last value in the row, s since the Unix epoch, UTC.
    pub time_s: Vec<f64>,
    /// Number of values in the row.
    pub count: Vec<u64>,
    /// Average of the means.
    pub mean: Vec<f64>,
    /// Square root of the average variance.
    pub std: Vec<f64>,
    /// Standard deviation of the means within the interval.
    pub spread: Vec<f64>,
    /// Smallest mean.
    pub least: Vec<f64>,
    /// Largest mean.
    pub largest: Vec<f64>,
    /// Lowest end of the 95 % intervals.
    pub low: Vec<f64>,
    /// Highest end of the 95 % intervals.
    pub high: Vec<f64>,
    /// Largest probability of loss; 0 for quantities without this probability.
    pub probability_of_loss: Vec<f64>,
}

/// Reply to a query for one quantity.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HistorySpan {
    /// Name of the structure whose history this is.
    pub structure: Name,
    /// Kind of the quantity: `parameter`, `loss`, `noise`, `outlier`, `class` or `node`.
    pub kind: String,
    /// Name of the quantity.
    pub name: String,
    /// Length of the intervals, s. `None` if each row is one value as displayed.
    pub resolution_s: Option<u32>,
    /// Time of the earliest stored value at any resolution, s since the Unix epoch, UTC. `None` if
    /// no value is stored.
    pub kept_from_s: Option<f64>,
    /// The rows, in chronological order.
    pub rows: HistoryRows,
}

/// Reply to a query for all alert changes, acknowledgements and events, oldest first.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HistoryLog {
    /// Name of the structure whose history this is.
    pub structure: Name,
    /// Changes of alerts.
    pub alerts: Vec<AlertMessage>,
    /// Acknowledgements of alerts.
    pub acknowledgements: Vec<Acknowledgement>,
    /// Restarts, calibrations, faults.
    pub events: Vec<Event>,
}

impl Message for HistorySpan {
    const TYPE: &'static str = "history-span";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_label("kind", &self.kind)?;
        check_label("name", &self.name)?;
        let rows = &self.rows;
        check_count("rows", rows.time_s.len(), 0, MAX_ITEMS)?;
        let columns = [
            ("mean", &rows.mean),
            ("std", &rows.std),
            ("spread", &rows.spread),
            ("least", &rows.least),
            ("largest", &rows.largest),
            ("low", &rows.low),
            ("high", &rows.high),
            ("probability of loss", &rows.probability_of_loss),
        ];
        let expected = rows.time_s.len();
        for (what, found) in columns
            .iter()
            .map(|(what, column)| (*what, column.len()))
            .chain([("count", rows.count.len())])
        {
            if found != expected {
                return Err(Malformed::Length {
                    what,
                    found,
                    expected,
                });
            }
        }
        check_finite_list("time", &rows.time_s)?;
        columns
            .iter()
            .try_for_each(|(what, column)| check_finite_list(what, column))
    }
}

impl Message for HistoryLog {
    const TYPE: &'static str = "history-log";
    const VERSION: u16 = 2;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_count("alerts", self.alerts.len(), 0, MAX_ITEMS)?;
        check_count(
            "acknowledgements",
            self.acknowledgements.len(),
            0,
            MAX_ITEMS,
        )?;
        check_count("events", self.events.len(), 0, MAX_ITEMS)?;
        self.alerts.iter().try_for_each(Message::check)?;
        self.acknowledgements.iter().try_for_each(Message::check)?;
        self.events.iter().try_for_each(Message::check)
    }
}
