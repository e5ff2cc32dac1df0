//! Waveforms from before those that the dashboard keeps, from the samples in the recording of
//! ingest.

use crate::api::Mistake;
use crate::history::Unkept;
use crate::samples::{check_length, read_range};
use crate::series::Table;
use crate::server::Server;
use crate::store::Store;
use crate::stretch::Stretch;
use axum::http::StatusCode;
use spandrel_bus::Service;

/// What the samples of a structure are like, and whether somebody may have recorded them.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Source {
    /// Number of channels of the structure file.
    channels: usize,
    /// Sampling rate (Hz).
    rate_hz: f64,
    /// Whether the service ingest is present.
    pub(crate) has_ingest: bool,
}

impl Source {
    pub(crate) fn of(store: &Store) -> Self {
        Self {
            channels: store.about.drawing.sensors.len(),
            rate_hz: store.about.sampling_rate_hz,
            has_ingest: store.state.has(Service::Ingest),
        }
    }
}

/// Reads the samples of some ranges of one structure, and reduces them to waveforms, one table per
/// range.
///
/// # Errors
/// The ranges are too long, ingest does not answer, another request reads samples, or there are no
/// samples.
pub(crate) async fn read(
    server: &Server,
    structure: &str,
    source: &Source,
    unkept: Vec<Unkept>,
) -> Result<Vec<Table>, Mistake> {
    let from_ns = unkept.iter().map(|one| one.from_ns).min();
    let to_ns = unkept.iter().map(|one| one.to_ns).max();
    let Some((from_ns, to_ns)) = from_ns.zip(to_ns) else {
        return Ok(Vec::new());
    };
    check_length(from_ns, to_ns, source.channels, source.rate_hz)?;
    let stretch = Stretch::new(from_ns, to_ns, source.channels);
    let (place, stretch) = read_range(server, structure, stretch).await?;
    let reduce = move || {
        let ranges = unkept.iter();
        let tables: Vec<Table> = ranges.map(|one| envelope(&stretch, one)).collect();
        drop(place); // the next request may read samples
        tables
    };
    // A million samples take milliseconds.
    let reduced = tokio::task::spawn_blocking(reduce).await;
    reduced.map_err(|error| {
        Mistake::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            error.to_string(),
            "try again",
        )
    })
}

/// Returns the least and the largest sample of a channel in equal intervals of a range, at the time
/// of the first sample of each interval. An interval without samples has no row.
///
/// `envelope` of `waveforms.js` reduces the samples on the page in the same way.
fn envelope(stretch: &Stretch, range: &Unkept) -> Table {
    let length_ns = range.to_ns.saturating_sub(range.from_ns) as f64;
    let step_ns = (length_ns / range.points as f64).max(1.0);
    let values = stretch.columns.get(range.sensor).into_iter().flatten();
    let mut rows: Vec<(i64, Vec<f64>)> = Vec::new();
    let mut interval = None;
    for (time_ns, value) in stretch.times_ns.iter().zip(values) {
        if value.is_nan() || !(range.from_ns..=range.to_ns).contains(time_ns) {
            continue;
        }
        let own = ((time_ns - range.from_ns) as f64 / step_ns) as usize;
        let own = Some(own.min(range.points - 1));
        match rows.last_mut().filter(|_| interval == own) {
            Some((_, ends)) => {
                ends[0] = ends[0].min(*value);
                ends[1] = ends[1].max(*value);
            }
            None => rows.push((*time_ns, vec![*value; 2])),
        }
        interval = own;
    }
    Table::of(2, rows.into_iter())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_have_their_extremes_at_the_time_of_their_first_sample() {
        let mut stretch = Stretch::new(0, 100, 2);
        stretch.times_ns = vec![0, 10, 20, 30, 60, 70, 100];
        stretch.columns = vec![vec![0.0; 7], vec![5.0, f64::NAN, 7.0, 6.0, -1.0, 3.0, 2.0]];
        let rows = |from_ns, to_ns, points| {
            let table = envelope(&stretch, &Unkept::new(1, from_ns, to_ns, points));
            let values = |row| table.row(row).collect::<Vec<f64>>();
            let times: Vec<i64> = table.times_ns().collect();
            times
                .into_iter()
                .enumerate()
                .map(|(row, time_ns)| (time_ns, values(row)))
                .collect::<Vec<_>>()
        };
        // Four intervals of 25 ns. The last sample belongs to the last interval.
        assert_eq!(
            rows(0, 100, 4),
            [
                (0, vec![5.0, 7.0]),
                (30, vec![6.0, 6.0]),
                (60, vec![-1.0, 3.0]),
                (100, vec![2.0, 2.0]),
            ]
        );
        assert_eq!(rows(0, 100, 1), [(0, vec![-1.0, 7.0])]);
        assert_eq!(rows(10, 30, 100).len(), 2, "no more rows than samples");
        assert!(rows(40, 50, 4).is_empty());
    }
}
