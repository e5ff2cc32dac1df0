//! PEER records (AT2, VT2, DT2): four header lines, then the numbers of one channel.
//!
//! The header lines are the title; earthquake, station and component; quantity and unit; number of
//! points and time step. The fourth line has one of two forms:
//!
//! - `NPTS=  4000, DT= .01000 SEC`
//! - `4000  0.0100  NPTS, DT`
//!
//! The numbers have fields of 15 characters, mostly five per line.
//!
//! Source: Pacific Earthquake Engineering Research Center, *NGA strong motion database*, file
//! format.

use super::text_lines::{NumberColumns, TextLines, decimal, text_of};
use crate::fault::Fault;
use crate::rate::rate_from_step;
use crate::recorded::{RecordedChannel, Segment};

const FIELD_WIDTH: usize = 15;

/// Returns `true` if the head of a file is that of a PEER record.
pub(crate) fn is_at2(head: &str) -> bool {
    let mut lines = head.lines();
    let title = lines
        .next()
        .is_some_and(|line| line.to_ascii_uppercase().contains("PEER"));
    title
        && lines
            .take(3)
            .any(|line| line.to_ascii_uppercase().contains("NPTS"))
}

/// Reads the channel of a file.
pub(crate) fn read(bytes: &[u8]) -> Result<Vec<RecordedChannel>, Fault> {
    let text = text_of(bytes);
    let mut lines = TextLines::new(&text);
    lines.line("the title")?;
    let place = lines.line("the earthquake and station")?.trim();
    let units = lines.line("the units")?.to_ascii_uppercase();
    let points = lines.line("the number of points")?;
    let (count, step_s) = points_and_step(points).ok_or_else(|| {
        let allowed = "`NPTS= points, DT= seconds SEC` or `points seconds NPTS, DT`";
        Fault::at_line(
            lines.number(),
            "number of points",
            format!("`{}`", points.trim()),
            allowed,
        )
    })?;
    let name = ["ACCELERATION", "VELOCITY", "DISPLACEMENT"]
        .into_iter()
        .find(|name| units.contains(name));
    let name = name.unwrap_or("samples").to_ascii_lowercase();
    let unit = units.split_once("UNITS OF").map(|(_, unit)| unit.trim());
    let unit = unit
        .and_then(|unit| unit.split([' ', ',', ';']).next())
        .unwrap_or_default();
    let unit = unit.trim_end_matches('.').to_ascii_lowercase();

    // The number of fields per line varies between files, so the first line of numbers determines
    // it.
    let per_line = lines
        .clone()
        .next()
        .map_or(1, |line| line.trim_end().len().div_ceil(FIELD_WIDTH).max(1));
    let columns = NumberColumns {
        per_line,
        width: FIELD_WIDTH,
    };
    let samples = lines.numbers(columns, count, &name)?;
    let channel = RecordedChannel::new(
        name,
        Some(rate_from_step(step_s)),
        vec![Segment::new(0, samples)],
    );
    Ok(vec![channel.with_unit(unit).with_description(place)])
}

/// Returns the number of points and the time step (s) from either form of the fourth line.
fn points_and_step(line: &str) -> Option<(usize, f64)> {
    let upper = line.to_ascii_uppercase();
    let after = |key: &str| {
        let rest = upper
            .split_once(key)?
            .1
            .trim_start()
            .strip_prefix('=')?
            .trim_start();
        rest.split([' ', ',']).next()
    };
    let mut words = upper.split_whitespace();
    let (points, step) = match (after("NPTS"), after("DT")) {
        (Some(points), Some(step)) => (points, step),
        _ => (words.next()?, words.next()?),
    };
    let step_s = decimal(step).filter(|step_s| *step_s > 0.0)?;
    Some((points.parse().ok().filter(|points| *points > 0)?, step_s))
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = "PEER STRONG MOTION DATABASE RECORD\nHILL 1/2/03, HALL, 90\n\
                        ACCELERATION TIME HISTORY IN UNITS OF G. FILTER\n\
        NPTS=     7, DT= .00500 SEC\n   .1000000E-02  -.2000000E-02   .3000000E-02   \
        .4000000E-02   .5000000E-02\n\
        \u{20}  .6000000E-02  -.7000000E-02\n";

    #[test]
    fn samples_rate_and_unit_are_read() {
        let channels = read(FILE.as_bytes()).unwrap();
        let channel = &channels[0];
        assert_eq!(
            (channel.name(), channel.unit()),
            ("acceleration", Some("g"))
        );
        assert_eq!(channel.sampling_rate_hz(), Some(200.0));
        assert_eq!(
            channel.samples().collect::<Vec<_>>(),
            [1e-3, -2e-3, 3e-3, 4e-3, 5e-3, 6e-3, -7e-3]
        );
        assert!(is_at2(FILE));
    }

    #[test]
    fn newer_header_is_read() {
        assert_eq!(
            points_and_step("   4096    0.0100   NPTS, DT"),
            Some((4096, 0.01))
        );
        assert_eq!(
            points_and_step("NPTS=   5372, DT=   .0100 SEC,"),
            Some((5372, 0.01))
        );
        assert_eq!(points_and_step("NPTS=  -1, DT= .01 SEC"), None);
        assert_eq!(points_and_step("NPTS=  10, DT= 0 SEC"), None);
    }

    #[test]
    fn file_cut_anywhere_is_refused() {
        for end in 0..FILE.len() - 1 {
            assert!(read(&FILE.as_bytes()[..end]).is_err(), "cut at {end}");
        }
    }
}
