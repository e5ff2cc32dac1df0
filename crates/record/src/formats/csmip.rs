//! CSMIP volume 2: a sequence of channels, each with acceleration, velocity and displacement.
//!
//! Each channel has 25 lines of text, integers and reals, and three blocks of samples. A line such
//! as one of these precedes each block, the second one in older files:
//!
//! - `10100 points of accel data equally spaced at 0.010 sec, in cm/sec2. (8f10.5)`
//! - `3000 POINTS OF ACCEL DATA EQUALLY SPACED AT .020 SEC. (UNITS: CM/SEC/SEC)`
//!
//! This module reads the lines of text only, because the integers and reals repeat them with fewer
//! digits.
//!
//! The first of these lines that is complete dates the first sample:
//!
//! - `Start time: 12/20/22, 10:34: 1.0 UTC (GPS)`
//! - `TRIGGER TIME: 11/21/86, 23:33:12.6 GMT`, because these recorders have no memory and start
//!   with the trigger
//! - `Rcrd of Fri Oct 11, 2013 16:05:59.0 PDT`. Such a file states its start to the minute only,
//!   as `23:05 GMT (*LoQ*)`: the clock of the recorder was of low quality.
//!
//! A clock of low quality dates the event. Its times of several recorders of one event differ by up
//! to an hour, although all of them were triggered together. They therefore cannot align channels.
//!
//! `(ORIGIN(USGS): 04/25/92, 18:06:04.2 GMT)` is the time of the earthquake. The recorder starts
//! when its waves arrive, some seconds to a minute later. This time therefore dates the event, and
//! no sample.
//!
//! Source: California Strong Motion Instrumentation Program, *Standard tape format for processed
//! strong-motion data* (Shakal and Huang 1985, report OSMS 85-03).

use super::text_lines::{NumberColumns, TextLines, columns_of, decimal, text_of};
use crate::fault::Fault;
use crate::rate::rate_from_step;
use crate::record_time::civil_ns;
use crate::recorded::{RecordedChannel, Segment, StartTime, TimeOrigin};

/// Default columns for files that do not state them.
const COLUMNS: NumberColumns = NumberColumns {
    per_line: 8,
    width: 10,
};

const MONTHS: [&str; 12] = [
    "jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec",
];

/// Time zones of the program, and the hours by which they are behind UTC.
const ZONES: [(&str, i64); 4] = [("pst", 8), ("pdt", 7), ("utc", 0), ("gmt", 0)];

/// Returns `true` if the head of a file is that of a CSMIP volume 2 file.
pub(crate) fn is_csmip(head: &str) -> bool {
    let lower = head
        .lines()
        .next()
        .unwrap_or_default()
        .trim_start()
        .to_ascii_lowercase();
    lower.starts_with("corrected accelerogram")
}

/// The content of the text lines of one channel.
#[derive(Debug, Clone, Default)]
struct Heading {
    channel: Option<u32>,
    place: String,
    /// Time of the first sample, as `Start time` or `TRIGGER TIME` states it.
    start_ns: Option<i64>,
    /// Time of the first sample, as `Rcrd of` states it in local time.
    local_start_ns: Option<i64>,
    /// Whether the clock was of low quality.
    is_low_quality: bool,
    /// Time of the earthquake.
    event_ns: Option<i64>,
}

/// Reads all blocks of all channels. Their names are `channel-N.acceleration` and so on.
pub(crate) fn read(bytes: &[u8]) -> Result<Vec<RecordedChannel>, Fault> {
    let text = text_of(bytes);
    let mut lines = TextLines::new(&text);
    let mut channels = Vec::new();
    let mut heading = Heading::default();
    let mut blocks = 0;
    while let Some(line) = lines.next() {
        let lower = line.to_ascii_lowercase();
        if lower.contains("end of data for channel") {
            blocks_of_channel(blocks, lines.number())?;
            (heading, blocks) = (Heading::default(), 0);
        } else if lower.contains("points of") && lower.contains("equally spaced") {
            channels.push(read_block(&mut lines, &lower, &heading)?);
            blocks += 1;
        } else if lower.contains("points of") && lower.contains("data unequally") {
            let allowed = "equally spaced samples (volume 2)";
            return Err(Fault::at_line(
                lines.number(),
                "data",
                "unequally spaced",
                allowed,
            ));
        } else {
            heading.take(line, &lower);
        }
    }
    if blocks > 0 {
        return Err(Fault::at_line(
            lines.number(),
            "end of the file",
            "here",
            "after `End of data for channel`",
        ));
    }
    if channels.is_empty() {
        return Err(Fault::of_file("number of blocks of data", 0, "at least 1"));
    }
    Ok(channels)
}

fn blocks_of_channel(blocks: usize, line: u64) -> Result<(), Fault> {
    match blocks {
        0 => Err(Fault::at_line(
            line,
            "number of blocks of this channel",
            0,
            "at least 1",
        )),
        _ => Ok(()),
    }
}

fn read_block(
    lines: &mut TextLines<'_>,
    lower: &str,
    heading: &Heading,
) -> Result<RecordedChannel, Fault> {
    let line = lines.number();
    let refused = |what: &str, allowed: &str| {
        Fault::at_line(line, what, format!("`{}`", lower.trim()), allowed)
    };
    let mut words = lower.split_whitespace();
    let count: usize = words
        .next()
        .and_then(|count| count.parse().ok())
        .ok_or_else(|| refused("number of points", "a number, then `points of`"))?;
    let quantity = match words.nth(2) {
        Some("accel") => "acceleration",
        Some("veloc") => "velocity",
        Some("displ") => "displacement",
        _ => return Err(refused("quantity", "accel, veloc or displ")),
    };
    let step_s = lower
        .split_once("spaced at")
        .and_then(|(_, rest)| rest.split_whitespace().next())
        .and_then(decimal);
    let step_s = step_s
        .filter(|step_s| *step_s > 0.0)
        .ok_or_else(|| refused("time step", "`spaced at SECONDS sec`"))?;
    let unit = lower.split_once("units:").or_else(|| {
        lower
            .split_once("in cm")
            .map(|(before, _)| (before, &lower[before.len() + 3..]))
    });
    let unit = unit.and_then(|(_, rest)| rest.split([' ', ')', '(']).find(|word| !word.is_empty()));
    let unit = unit.unwrap_or_default().trim_end_matches('.');
    let columns = lower
        .rsplit_once('(')
        .and_then(|(_, rest)| columns_of(rest.split(')').next()?))
        .unwrap_or(COLUMNS);
    let samples = lines.numbers(columns, count, quantity)?;
    let name = match heading.channel {
        Some(number) => format!("channel-{number}.{quantity}"),
        None => quantity.to_owned(),
    };
    let start_ns = heading.start_ns.or(heading.local_start_ns);
    let segment = Segment::new(start_ns.unwrap_or(0), samples);
    let origin = if start_ns.is_some() {
        TimeOrigin::Epoch
    } else {
        TimeOrigin::Start
    };
    let start_time = match start_ns {
        _ if heading.is_low_quality => StartTime::LowQuality,
        Some(_) => StartTime::Stated,
        None => StartTime::Missing,
    };
    let channel = RecordedChannel::new(name, Some(rate_from_step(step_s)), vec![segment]);
    Ok(channel
        .with_unit(unit)
        .with_description(heading.place.clone())
        .with_event_ns(heading.event_ns)
        .with_origin(origin)
        .with_start_time(start_time))
}

impl Heading {
    /// Parses a line of text.
    fn take(&mut self, line: &str, lower: &str) {
        for key in ["start time:", "trigger time:"] {
            if let Some((_, rest)) = lower.split_once(key) {
                self.start_ns = self.start_ns.or_else(|| universal_ns(rest));
                self.is_low_quality |= rest.contains("*loq*");
            }
        }
        let local = ["rcrd of ", "record of "].map(|key| lower.strip_prefix(key));
        if let Some(rest) = local.into_iter().flatten().next() {
            self.local_start_ns = self.local_start_ns.or_else(|| local_ns(rest));
        }
        if let Some((_, rest)) = lower.split_once("(origin") {
            let time = rest
                .split_once(':')
                .and_then(|(_, time)| universal_ns(time));
            self.event_ns = self.event_ns.or(time);
        }
        if let Some(rest) = lower.strip_prefix("chan") {
            let number = rest
                .trim_start()
                .split(':')
                .next()
                .and_then(|number| number.trim().parse().ok());
            // Older files state the channel of the recorder first, and then `(STA CHN:  7)`.
            let station = lower
                .split_once("sta chn:")
                .and_then(|(_, rest)| rest.split(')').next()?.trim().parse().ok());
            self.channel = station.or(number).or(self.channel);
            let words = line.split_once(':').map_or(line, |(_, words)| words);
            self.place = words.split_whitespace().collect::<Vec<_>>().join(" ");
        }
    }
}

/// Parses `12/20/22, 10:34: 1.0 UTC`. Two-digit years are 1970 to 2069.
fn universal_ns(text: &str) -> Option<i64> {
    let (date, time) = text.split_once(',')?;
    let time = time.split_once("utc").or_else(|| time.split_once("gmt"))?.0;
    let mut date = date.split('/').map(|part| part.trim().parse::<i64>().ok());
    let (month, day, year) = (date.next()??, date.next()??, date.next()??);
    let year = match year {
        0..70 => 2000 + year,
        70..100 => 1900 + year,
        _ => year,
    };
    let (hour, minute, second) = time_of_day(time)?;
    civil_ns(year, month, day, hour, minute, second)
}

/// Parses `Fri Oct 11, 2013 16:05:59.0 PDT`.
fn local_ns(text: &str) -> Option<i64> {
    let words: Vec<&str> = text.split_whitespace().collect();
    let [_, month, day, year, time, zone, ..] = words[..] else {
        return None;
    };
    let month = MONTHS.iter().position(|name| *name == month)? as i64 + 1;
    let day = day.trim_end_matches(',').parse().ok()?;
    let (hour, minute, second) = time_of_day(time)?;
    let (_, behind_h) = ZONES.iter().find(|(name, _)| *name == zone)?;
    let local_ns = civil_ns(year.parse().ok()?, month, day, hour, minute, second)?;
    local_ns.checked_add(behind_h * 3_600_000_000_000)
}

/// Parses `10:34: 1.0` as hour, minute and second.
fn time_of_day(text: &str) -> Option<(i64, i64, f64)> {
    let mut parts = text.split(':').map(str::trim);
    let hour = parts.next()?.parse().ok()?;
    let minute = parts.next()?.parse().ok()?;
    Some((hour, minute, decimal(parts.next()?)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file() -> String {
        let mut text = String::new();
        for channel in [4, 7] {
            text += "Corrected accelerogram   89324   Chan  1:  Tran       from\n";
            text += "89324-VAA6D           Start time: 12/20/22, 10:34: 1.5 UTC (GPS)\n";
            text += &format!("Chan  {channel}:  Tran     Location: Top of column\n");
            text +=
                "  9 points of instrument- and baseline-corrected accel, veloc and displ data\n";
            for (quantity, unit) in [
                ("accel", "cm/sec2."),
                ("veloc", "cm/sec. "),
                ("displ", "cm.     "),
            ] {
                text += &format!(
                    " 9 points of {quantity} data equally spaced at 0.010 sec, in {unit} (8f10.5)\n"
                );
                text += &format!("{}\n   1.00000\n", "-100.12345".repeat(8));
            }
            text += &format!("/&  ----------  End of data for channel  {channel}  ----------\n");
        }
        text
    }

    #[test]
    fn channels_blocks_units_and_start_are_read() {
        let channels = read(file().as_bytes()).unwrap();
        let names: Vec<&str> = channels.iter().map(RecordedChannel::name).collect();
        let quantities = ["acceleration", "velocity", "displacement"];
        let expected: Vec<String> = [4, 7]
            .iter()
            .flat_map(|n| quantities.map(|quantity| format!("channel-{n}.{quantity}")))
            .collect();
        assert_eq!(names, expected);
        let units: Vec<_> = channels
            .iter()
            .take(3)
            .map(|channel| channel.unit().unwrap())
            .collect();
        assert_eq!(units, ["cm/sec2", "cm/sec", "cm"]);
        assert_eq!(
            channels[0].samples().collect::<Vec<_>>()[7..],
            [-100.12345, 1.0]
        );
        // Source: `date -u -d '2022-12-20T10:34:01Z' +%s`
        assert_eq!(channels[5].start_ns(), Some(1_671_532_441_500_000_000));
        assert_eq!(
            channels[0].description(),
            Some("Tran Location: Top of column")
        );
    }

    /// Returns the file with another line instead of its start, and a line before it.
    fn dated(line: &str) -> RecordedChannel {
        let start = "89324-VAA6D           Start time: 12/20/22, 10:34: 1.5 UTC (GPS)\n";
        read(file().replace(start, line).as_bytes())
            .unwrap()
            .remove(0)
    }

    /// Each of these forms is in an archive of the station 89324.
    /// Source of the times: `date -u -d '2013-10-11T16:05:59-07:00' +%s` and so on.
    #[test]
    fn start_to_the_minute_takes_its_seconds_from_the_local_time() {
        let lines = "Rcrd of Fri Oct 11, 2013 16:05:59.0 PDT               (Avol1 v0.1, 4/13 \
                     CSMIP)\n\
            CSMIP Preliminary Processing            (Origin:  To be determined)\n\
            89324-VA874-13284.06                 Start time: 10/11/13, 23:05 GMT (*LoQ*)\n";
        let channel = dated(lines);
        assert_eq!(channel.start_ns(), Some(1_381_532_759_000_000_000));
        assert_eq!(
            (channel.origin(), channel.event_ns()),
            (TimeOrigin::Epoch, None)
        );
        assert_eq!(channel.start_time(), StartTime::LowQuality);
        let winter = dated("Rcrd of Thu Dec  8, 2016 06:50:16.0 PST\n");
        assert_eq!(winter.start_ns(), Some(1_481_208_616_000_000_000));
        assert_eq!(winter.start_time(), StartTime::Stated);
    }

    #[test]
    fn time_of_the_trigger_is_the_start() {
        let channel = dated(
            "NOVEMBER 21, 1986  15:33 PST            (ORIGIN(USGS): 11/21/86, 23:33:01.8 GMT)\n\
            89324-C0161-86328.01               TRIGGER TIME: 11/21/86, 23:33:12.6 GMT\n",
        );
        assert_eq!(channel.start_ns(), Some(532_999_992_600_000_000));
        assert_eq!(channel.event_ns(), Some(532_999_981_800_000_000));
    }

    #[test]
    fn time_of_the_earthquake_dates_no_sample() {
        let lines = "DEC 16, 1982 06:53 UTC                  (ORIGIN(PDE): 12/16/82, 06:53:01.3 \
                     UTC)\n\
            89324-C0161-83238.01               TRIGGER TIME: 12/16/82, 06:53:XX.X UTC\n";
        let channel = dated(lines);
        assert_eq!(
            (channel.origin(), channel.start_ns()),
            (TimeOrigin::Start, Some(0))
        );
        assert_eq!(channel.event_ns(), Some(408_869_581_300_000_000));
    }

    #[test]
    fn older_layout_is_read() {
        let file = "CORRECTED ACCELEROGRAM   89324\n\
                    CHAN  2: 360 DEG  (STA CHN:  7)     LOCATION: DECK\n\
            \u{20}2 POINTS OF ACCEL DATA EQUALLY SPACED AT  .020 SEC.  (UNITS: CM/SEC/SEC)\n     \
            8.750    11.303\n\
            /&  ----------  END OF DATA FOR CHANNEL  7  ----------\n";
        let channels = read(file.as_bytes()).unwrap();
        assert_eq!(
            (channels[0].name(), channels[0].unit()),
            ("channel-7.acceleration", Some("cm/sec/sec"))
        );
        assert_eq!(
            (channels[0].sampling_rate_hz(), channels[0].origin()),
            (Some(50.0), TimeOrigin::Start)
        );
    }

    #[test]
    fn file_cut_anywhere_is_refused_or_lacks_whole_channels() {
        let file = file();
        let first = file.find("End of data").unwrap();
        for end in 0..file.len() {
            match read(&file.as_bytes()[..end]) {
                Ok(channels) => assert!(
                    channels.len() == 3 && end > first || channels.len() == 6,
                    "cut at {end}"
                ),
                Err(_) => assert!(end <= file.len() - 10, "cut at {end}"),
            }
        }
    }
}
