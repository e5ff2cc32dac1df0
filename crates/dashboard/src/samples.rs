//! Requests for the samples of a time range, as a file.

use crate::api::Mistake;
use crate::history::{Refused, time};
use crate::server::Server;
use crate::stretch::{MOST_SAMPLES, Stretch, Unreadable};
use axum::http::StatusCode;
use axum::http::header::{CONTENT_DISPOSITION, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use spandrel_bus::is_without_date;
use spandrel_record::{
    Format, OutputFormat, RecordError, RecordedChannel, RecordedFile, TimeOrigin,
};
use spandrel_structure::DrawnSensor;
use std::io::Cursor;
use std::path::Path;
use tokio::sync::OwnedSemaphorePermit;

/// A request before validation.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Asked {
    /// Seconds since the Unix epoch (UTC), or ISO 8601.
    from: Option<String>,
    to: Option<String>,
    format: Option<String>,
}

/// A requested range of samples, and the format of the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct WantedSamples {
    pub(crate) from_ns: i64,
    pub(crate) to_ns: i64,
    format: OutputFormat,
}

impl WantedSamples {
    /// Checks a request for the samples of `channels` channels at `rate_hz` (Hz).
    pub(crate) fn new(asked: &Asked, channels: usize, rate_hz: f64) -> Result<Self, Refused> {
        let refuse = |what: String, allowed: String| Err(Refused { what, allowed });
        let format = asked.format.as_deref().unwrap_or_default();
        let Ok(output) = OutputFormat::of(Path::new(&format!("samples.{format}"))) else {
            let what = format!(
                "format is `{}`",
                format.chars().take(64).collect::<String>()
            );
            return refuse(what, "must be csv, mcap or mseed".to_owned());
        };
        for (name, text) in [("from", &asked.from), ("to", &asked.to)] {
            if text.is_none() {
                return refuse(format!("{name} is missing"), "must be given".to_owned());
            }
        }
        let from_ns = time("from", asked.from.as_ref(), i64::MIN)?;
        let to_ns = time("to", asked.to.as_ref(), i64::MAX)?;
        let length_s = (to_ns as f64 - from_ns as f64) / 1e9;
        if length_s <= 0.0 {
            return refuse(
                "from is not before to".to_owned(),
                "from must come before to".to_owned(),
            );
        }
        check_length(from_ns, to_ns, channels, rate_hz)?;
        Ok(Self {
            from_ns,
            to_ns,
            format: output,
        })
    }

    /// Writes the samples as a file. The work takes up to seconds, so that it must not run on a
    /// thread of requests.
    pub(crate) fn write(
        self,
        name: &str,
        stretch: Stretch,
        sensors: &[DrawnSensor],
        rate_hz: f64,
    ) -> Result<Response, RecordError> {
        let (ending, kind) = match self.format {
            OutputFormat::Csv => ("csv", "text/csv; charset=utf-8"),
            OutputFormat::Mcap => ("mcap", "application/octet-stream"),
            OutputFormat::MiniSeed => ("mseed", "application/vnd.fdsn.mseed"),
        };
        let file_name = format!("{name}_{}.{ending}", stamp(self.from_ns));
        let origin = match is_without_date(self.from_ns) {
            true => TimeOrigin::Start,
            false => TimeOrigin::Epoch,
        };
        let Stretch {
            times_ns, columns, ..
        } = stretch;
        let channels = sensors.iter().zip(columns).map(|(sensor, values)| {
            RecordedChannel::from_times(&*sensor.channel, Some(rate_hz), &times_ns, &values)
                .with_unit(sensor.unit)
                .with_origin(origin)
        });
        let path = Path::new(&file_name);
        let file = RecordedFile::from_channels(path, Format::Mcap, channels.collect());
        let mut bytes = Vec::new();
        file.write_to(self.format, path, Cursor::new(&mut bytes))?;
        let headers = [
            (CONTENT_TYPE, kind.to_owned()),
            (
                CONTENT_DISPOSITION,
                format!("attachment; filename=\"{file_name}\""),
            ),
        ];
        Ok((headers, bytes).into_response())
    }
}

/// Checks that a range (ns) has at most [`MOST_SAMPLES`] samples of `channels` channels at
/// `rate_hz` (Hz).
pub(crate) fn check_length(
    from_ns: i64,
    to_ns: i64,
    channels: usize,
    rate_hz: f64,
) -> Result<(), Refused> {
    let length_s = (to_ns as f64 - from_ns as f64) / 1e9;
    let longest_s = MOST_SAMPLES as f64 / (channels.max(1) as f64 * rate_hz);
    if length_s <= longest_s {
        return Ok(());
    }
    Err(Refused {
        what: format!("the range is {length_s:.0} s long"),
        allowed: format!(
            "must be at most {longest_s:.0} s, for {MOST_SAMPLES} samples of {channels} channels"
        ),
    })
}

/// Reads the frames of a stretch. Returns them with the only place for reading samples, which is
/// free again once it is dropped.
///
/// # Errors
/// Another request reads samples, ingest does not answer, the recording does not match the
/// structure file, or there are no samples.
pub(crate) async fn read_range(
    server: &Server,
    structure: &str,
    stretch: Stretch,
) -> Result<(OwnedSemaphorePermit, Stretch), Mistake> {
    let unavailable =
        |what: &str, allowed: &str| Mistake::new(StatusCode::SERVICE_UNAVAILABLE, what, allowed);
    let place = server.admit_export().ok_or_else(|| {
        unavailable(
            "another export of samples is running",
            "try again in a few seconds",
        )
    })?;
    let stretch = server.read_stretch(structure, stretch).await?;
    let stretch = stretch.ok_or_else(|| {
        unavailable(
            "the service ingest does not answer",
            "must run for this structure; try again",
        )
    })?;
    if stretch.times_ns.is_empty() {
        return Err(Mistake::new(
            StatusCode::NOT_FOUND,
            "no samples in this range",
            "must be a range that ingest has recorded and still keeps",
        ));
    }
    Ok((place, stretch))
}

/// Returns the start of a range for the name of a file: a date, or seconds of a record without
/// dates.
fn stamp(time_ns: i64) -> String {
    let time = jiff::Timestamp::from_second(time_ns.div_euclid(1_000_000_000));
    match time {
        Ok(time) if !is_without_date(time_ns) => time.to_string().replace(':', "-"),
        _ => format!("{}s", time_ns / 1_000_000_000),
    }
}

impl From<Unreadable> for Mistake {
    fn from(unreadable: Unreadable) -> Self {
        match unreadable {
            Unreadable::Channels(found) => Self::new(
                StatusCode::CONFLICT,
                format!("the recording has {found} channels"),
                "must have the channels of the structure file",
            ),
            Unreadable::TooLong => Self::new(
                StatusCode::BAD_REQUEST,
                format!("the range has more than {MOST_SAMPLES} samples"),
                "must be a shorter range",
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wanted(from: &str, to: &str, format: &str) -> Result<WantedSamples, Refused> {
        let some = |text: &str| (!text.is_empty()).then(|| text.to_owned());
        let (from, to, format) = (some(from), some(to), some(format));
        WantedSamples::new(&Asked { from, to, format }, 20, 200.0)
    }

    #[test]
    fn range_and_format_are_required_and_limited() {
        let minute = wanted("2026-03-01T12:00:00Z", "2026-03-01T12:01:00Z", "mseed").unwrap();
        assert_eq!(minute.to_ns - minute.from_ns, 60_000_000_000);
        assert_eq!(minute.format, OutputFormat::MiniSeed);
        let what = |from, to, format| wanted(from, to, format).unwrap_err().what;
        assert_eq!(what("", "5", "csv"), "from is missing");
        assert_eq!(what("1", "", "csv"), "to is missing");
        assert_eq!(what("1", "5", ""), "format is ``");
        assert_eq!(what("1", "5", "json"), "format is `json`");
        assert_eq!(what("5", "5", "csv"), "from is not before to");
        // 1,000,000 samples of 20 channels at 200 Hz are 250 s.
        assert!(wanted("0", "250", "csv").is_ok());
        let long = wanted("0", "251", "csv").unwrap_err();
        assert_eq!(long.what, "the range is 251 s long");
        assert_eq!(
            long.allowed,
            "must be at most 250 s, for 1000000 samples of 20 channels"
        );
    }

    #[test]
    fn name_of_a_file_states_its_start() {
        assert_eq!(stamp(1_772_366_400_500_000_000), "2026-03-01T12-00-00Z");
        assert_eq!(stamp(12_500_000_000), "12s");
    }
}
