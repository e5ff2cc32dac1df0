//! Quiet hours of a receiver, in a time zone of its own.

use crate::state::NoticeState;
use jiff::civil::{Time, Weekday};
use jiff::tz::TimeZone;
use jiff::{Timestamp, ToSpan};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer};

/// A day of the week.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
pub enum Day {
    /// Monday
    Mon,
    /// Tuesday
    Tue,
    /// Wednesday
    Wed,
    /// Thursday
    Thu,
    /// Friday
    Fri,
    /// Saturday
    Sat,
    /// Sunday
    Sun,
}

impl Day {
    const ALL: [Self; 7] = [
        Self::Mon,
        Self::Tue,
        Self::Wed,
        Self::Thu,
        Self::Fri,
        Self::Sat,
        Self::Sun,
    ];

    fn weekday(self) -> Weekday {
        match self {
            Self::Mon => Weekday::Monday,
            Self::Tue => Weekday::Tuesday,
            Self::Wed => Weekday::Wednesday,
            Self::Thu => Weekday::Thursday,
            Self::Fri => Weekday::Friday,
            Self::Sat => Weekday::Saturday,
            Self::Sun => Weekday::Sunday,
        }
    }
}

impl TryFrom<String> for Day {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        match text.as_str() {
            "mon" => Ok(Self::Mon),
            "tue" => Ok(Self::Tue),
            "wed" => Ok(Self::Wed),
            "thu" => Ok(Self::Thu),
            "fri" => Ok(Self::Fri),
            "sat" => Ok(Self::Sat),
            "sun" => Ok(Self::Sun),
            _ => Err(format!(
                "unknown day {text:?}, must be one of mon, tue, wed, thu, fri, sat, sun"
            )),
        }
    }
}

fn every_day() -> Vec<Day> {
    Day::ALL.to_vec()
}

fn time_of_day<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Time, D::Error> {
    let text = String::deserialize(deserializer)?;
    let refuse = |_| D::Error::custom(format!("{text:?} is not a time, must be like \"22:00\""));
    text.parse().map_err(refuse)
}

/// A recurring period in which notices wait, such as every night.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct QuietHours {
    /// Days on which the hours begin.
    #[serde(default = "every_day")]
    pub days: Vec<Day>,
    /// Start, such as `22:00`.
    #[serde(deserialize_with = "time_of_day")]
    pub from: Time,
    /// End, such as `06:00`. An end that is not after the start is on the next day.
    #[serde(deserialize_with = "time_of_day")]
    pub to: Time,
    /// Time zone, such as `Europe/Zurich`.
    pub zone: String,
    /// States that do not wait.
    #[serde(default)]
    pub except: Vec<NoticeState>,
}

/// Quiet hours with their time zone.
#[derive(Clone, Debug)]
pub(crate) struct Quiet {
    hours: QuietHours,
    zone: TimeZone,
}

impl Quiet {
    /// Finds the time zone. Returns `None` if it is unknown.
    pub(crate) fn new(hours: &QuietHours) -> Option<Self> {
        let zone = TimeZone::get(&hours.zone).ok()?;
        let hours = hours.clone();
        Some(Self { hours, zone })
    }

    /// Returns `true` if a notice of this state must wait at a wall-clock time, ns since the Unix
    /// epoch, UTC. `None` is the state of a summary.
    pub(crate) fn holds(&self, state: Option<NoticeState>, wall_ns: i64) -> bool {
        let QuietHours {
            days,
            from,
            to,
            except,
            ..
        } = &self.hours;
        if state.is_some_and(|state| except.contains(&state)) {
            return false;
        }
        let Ok(now) = Timestamp::from_nanosecond(i128::from(wall_ns)) else {
            return false; // the calendar contains every time of 64 bits in ns
        };
        let today = now.to_zoned(self.zone.clone()).date();
        // Hours that began yesterday may last until today.
        let starts = [Some(today), today.yesterday().ok()];
        starts.into_iter().flatten().any(|day| {
            let end_day = match to > from {
                true => Some(day),
                false => day.checked_add(1.day()).ok(),
            };
            let moment = |date: jiff::civil::Date, time: Time| {
                let zoned = date.to_datetime(time).to_zoned(self.zone.clone());
                zoned.map(|zoned| zoned.timestamp()).ok()
            };
            let span = moment(day, *from).zip(end_day.and_then(|day| moment(day, *to)));
            let begins_here = days.iter().any(|one| one.weekday() == day.weekday());
            begins_here && span.is_some_and(|(start, end)| start <= now && now < end)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn quiet(days: &[Day], from: &str, to: &str) -> Quiet {
        Quiet::new(&QuietHours {
            days: days.to_vec(),
            from: from.parse().unwrap(),
            to: to.parse().unwrap(),
            zone: "Europe/Zurich".to_owned(),
            except: vec![NoticeState::Raised],
        })
        .unwrap()
    }

    fn holds(quiet: &Quiet, time: &str) -> bool {
        let time: Timestamp = time.parse().unwrap();
        let ns = i64::try_from(time.as_nanosecond()).unwrap();
        quiet.holds(Some(NoticeState::Degraded), ns)
    }

    #[test]
    fn night_begins_on_its_day_and_ends_on_the_next() {
        // 2026-11-20 is a Friday; Zurich is one hour ahead of UTC.
        let night = quiet(&[Day::Fri], "22:00", "06:00");
        for (time, expected) in [
            ("2026-11-20T20:59:59Z", false),
            ("2026-11-20T21:00:00Z", true),
            ("2026-11-21T04:59:59Z", true),
            ("2026-11-21T05:00:00Z", false),
            ("2026-11-21T21:30:00Z", false),
        ] {
            assert_eq!(holds(&night, time), expected, "{time}");
        }
        let raised = Some(NoticeState::Raised);
        let at: Timestamp = "2026-11-20T22:00:00Z".parse().unwrap();
        assert!(!night.holds(raised, i64::try_from(at.as_nanosecond()).unwrap()));
    }

    #[test]
    fn hours_follow_the_clock_of_the_zone_in_summer() {
        let night = quiet(&Day::ALL, "22:00", "06:00");
        assert!(holds(&night, "2026-07-01T20:30:00Z"), "22:30 in Zurich");
        assert!(!holds(&night, "2026-11-20T20:30:00Z"), "21:30 in Zurich");
    }

    #[test]
    fn equal_times_are_a_whole_day() {
        let weekend = quiet(&[Day::Sat, Day::Sun], "00:00", "00:00");
        assert!(holds(&weekend, "2026-11-21T12:00:00Z"));
        assert!(holds(&weekend, "2026-11-22T22:59:59Z"));
        assert!(!holds(&weekend, "2026-11-22T23:00:00Z"));
    }
}
