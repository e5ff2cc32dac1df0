//! The content of a notice: what is reported, and the circumstances at that moment.

use crate::advice::advice;
use crate::clocks::ClockChange;
use crate::origin::Origin;
use crate::state::NoticeState;
use serde::{Deserialize, Serialize};
use spandrel_bus::{
    AlertMessage, ChannelMonitoring, Event, FitReasons, FitVerdict, JudgementDisplay,
    MonitoringDisplay, MonitoringState, Name, ReportPage, fit_in_words, is_without_date,
};
use std::collections::{BTreeMap, BTreeSet};

/// Maximum number of channels, and of other alerts, in a notice.
const MOST_LISTED: usize = 8;

/// What a notice reports.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) enum Report {
    /// A change of an alert.
    Alert(AlertMessage),
    /// A change of the monitoring of a structure.
    Monitoring(MonitoringDisplay),
    /// What was held back during quiet hours or maintenance.
    Summary(Summary),
    /// A lasting change of a quantity.
    Judgement(JudgementDisplay),
    /// A report of an earthquake, which is ready.
    Earthquake(Event),
    /// The clock of a node has become wrong or right.
    Clock(ClockChange),
}

/// A summary of notices that were held back.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Summary {
    pub(crate) structure: Name,
    /// Wall-clock time, ns since the Unix epoch, UTC.
    pub(crate) time_ns: i64,
    /// Why the notices were held back.
    pub(crate) cause: String,
    /// One line per notice.
    pub(crate) lines: Vec<String>,
}

/// The circumstances of a report.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Circumstances {
    /// Description of the structure; empty without one.
    pub(crate) title: String,
    /// Location of the structure; empty if the structure file does not state it.
    pub(crate) place: String,
    /// How well the model explains the data; empty if it is not assessed.
    pub(crate) fit: String,
    /// How good the data are.
    pub(crate) quality: String,
    /// Other alerts of the structure that are not normal.
    pub(crate) others: Vec<String>,
    pub(crate) origin: Origin,
    /// What to look at first.
    pub(crate) advice: String,
    /// Address of the page at the moment of the report; empty without a public address.
    pub(crate) link: String,
    /// Whom to call; empty if the structure file does not say. The present file decides when a
    /// notice is sent, so that checkpoints omit it.
    #[serde(skip)]
    pub(crate) contact: String,
    /// Address of the instructions; empty if the structure file does not say. Checkpoints omit it.
    #[serde(skip)]
    pub(crate) runbook: String,
}

/// The subject of a notice: the structure, the part of an alert, and the concern.
pub(crate) type Subject = (Name, Option<Name>, Concern);

/// What a notice is about. A part can have an alert and a lasting change at the same time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Concern {
    /// The present state of a part or of the monitoring.
    Present,
    /// A lasting change.
    Lasting,
    /// The report of an earthquake.
    Earthquake,
    /// The clock of a node, which is the part.
    Clock,
}

/// The content of a notice.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Content {
    /// Key of the change, the same for duplicates.
    pub(crate) key: String,
    pub(crate) report: Report,
    pub(crate) circumstances: Circumstances,
    /// Time for which nobody reacted, s, if the notice is an escalation.
    pub(crate) unanswered_s: Option<u64>,
    /// Whether this is a test with made-up values.
    pub(crate) is_test: bool,
}

impl Content {
    pub(crate) fn new(report: Report, circumstances: Circumstances) -> Self {
        Self {
            key: key(&report),
            report,
            circumstances,
            unanswered_s: None,
            is_test: false,
        }
    }

    /// Returns the state. A summary has none.
    pub(crate) fn state(&self) -> Option<NoticeState> {
        match &self.report {
            Report::Alert(alert) => Some(alert.state.into()),
            Report::Monitoring(display) => Some(display.state.into()),
            Report::Summary(_) => None,
            Report::Judgement(display) => display.change.map(|change| change.kind.into()),
            Report::Earthquake(_) => Some(NoticeState::EarthquakeReport),
            Report::Clock(change) => Some(change.state()),
        }
    }

    /// Returns `true` if the state requires action, and nobody has acknowledged it.
    pub(crate) fn is_open(&self) -> bool {
        match &self.report {
            Report::Alert(alert) if alert.stands() => alert.is_unseen(),
            _ => self.state().is_some_and(NoticeState::is_open),
        }
    }

    pub(crate) fn structure(&self) -> &Name {
        match &self.report {
            Report::Alert(alert) => &alert.structure,
            Report::Monitoring(display) => &display.structure,
            Report::Summary(summary) => &summary.structure,
            Report::Judgement(display) => &display.structure,
            Report::Earthquake(event) => &event.structure,
            Report::Clock(change) => &change.structure,
        }
    }

    /// Returns the part of an alert, the judged quantity, or the node of a clock.
    pub(crate) fn part(&self) -> Option<&Name> {
        match &self.report {
            Report::Alert(alert) => Some(&alert.parameter),
            Report::Judgement(display) => Some(&display.quantity),
            Report::Clock(change) => Some(&change.node),
            Report::Monitoring(_) | Report::Summary(_) | Report::Earthquake(_) => None,
        }
    }

    pub(crate) fn subject(&self) -> Subject {
        let concern = match &self.report {
            Report::Judgement(_) => Concern::Lasting,
            Report::Earthquake(_) => Concern::Earthquake,
            Report::Clock(_) => Concern::Clock,
            Report::Alert(_) | Report::Monitoring(_) | Report::Summary(_) => Concern::Present,
        };
        (self.structure().clone(), self.part().cloned(), concern)
    }

    /// Returns the time of the report, ns since the Unix epoch, UTC: the measurement time of an
    /// alert, the start of the day of a lasting change, and otherwise the wall-clock time.
    pub(crate) fn time_ns(&self) -> i64 {
        match &self.report {
            Report::Alert(alert) => alert.time_ns,
            Report::Monitoring(display) => display.time_ns,
            Report::Summary(summary) => summary.time_ns,
            Report::Judgement(display) => display
                .change
                .map_or(display.time_ns, |change| change.found_ns),
            Report::Earthquake(event) => event.time_ns,
            Report::Clock(change) => change.time_ns,
        }
    }

    /// Returns the report in one sentence without a full stop.
    pub(crate) fn sentence(&self) -> String {
        match &self.report {
            Report::Alert(alert) => alert.why.clone(),
            Report::Monitoring(display) => {
                let structure = &display.structure;
                match display.state {
                    MonitoringState::Watching => format!(
                        "{structure} is watched again: the present data reveal damage of every part"
                    ),
                    MonitoringState::Degraded => format!(
                        "{structure} is watched only in part: {}",
                        display.reasons.join("; ")
                    ),
                    MonitoringState::Blind => format!(
                        "{structure} is not watched, damage would not be noticed: {}",
                        display.reasons.join("; ")
                    ),
                }
            }
            Report::Summary(summary) => match summary.lines.len() {
                1 => format!("{}: 1 notice was held back", summary.cause),
                count => format!("{}: {count} notices were held back", summary.cause),
            },
            Report::Judgement(display) => display.sentence.trim_end_matches('.').to_owned(),
            Report::Earthquake(event) => format!("{}: {}", event.what, event.why),
            Report::Clock(change) => {
                let ClockChange {
                    structure,
                    node,
                    what,
                    ..
                } = change;
                format!("node {node} of {structure}: {what}")
            }
        }
    }

    /// Returns how this report ends another one, in a line of a summary.
    pub(crate) fn end(&self) -> String {
        let state = self.state().map_or("", NoticeState::as_str);
        format!("{state} at {}", iso_8601(self.time_ns()))
    }

    /// Returns the report in a line of a summary.
    pub(crate) fn line(&self) -> String {
        let (time, sentence) = (iso_8601(self.time_ns()), self.sentence());
        if matches!(self.report, Report::Earthquake(_)) {
            return format!("{time} {sentence}"); // the sentence names the report
        }
        let state = self.state().map_or("", NoticeState::as_str);
        let what = self.part().map_or("monitoring", |part| part.as_str());
        format!("{time} {what} {state}: {sentence}")
    }
}

fn key(report: &Report) -> String {
    match report {
        Report::Alert(alert) => alert_key(alert),
        // No alert has such a state, even of a parameter with this name.
        Report::Monitoring(display) => format!(
            "{}/monitoring/{}/{}",
            display.structure,
            display.time_ns,
            display.state.as_str()
        ),
        Report::Summary(summary) => {
            format!("{}/summary/{}", summary.structure, summary.time_ns)
        }
        Report::Judgement(display) => judgement_key(display),
        Report::Earthquake(event) => {
            format!("{}/earthquake-report/{}", event.structure, event.subject)
        }
        Report::Clock(change) => {
            let ClockChange {
                structure,
                node,
                time_ns,
                ..
            } = change;
            format!("{structure}/{node}/{time_ns}/{}", change.state().as_str())
        }
    }
}

/// Returns the key of a lasting change. No alert has such a state.
pub(crate) fn judgement_key(display: &JudgementDisplay) -> String {
    format!(
        "{}/{}/{}/{}",
        display.structure,
        display.quantity,
        display.change.map_or(0, |change| change.found_ns),
        display.word()
    )
}

/// Returns the key of a change of an alert.
pub(crate) fn alert_key(alert: &AlertMessage) -> String {
    format!(
        "{}/{}/{}/{}",
        alert.structure,
        alert.parameter,
        alert.time_ns,
        alert.state.as_str()
    )
}

/// Constant facts about a structure.
#[derive(Clone, Debug)]
pub(crate) struct Facts {
    pub(crate) structure: Name,
    pub(crate) title: String,
    pub(crate) place: String,
    pub(crate) contact: String,
    pub(crate) runbook: String,
    /// Names of the parameters.
    pub(crate) parameters: Vec<String>,
    /// Names of the channels of each node, by the name of the node.
    pub(crate) channels: Vec<(String, Vec<String>)>,
    /// Whether an alert service watches the structure.
    pub(crate) has_alert_service: bool,
    /// Public address of the page, without a slash at the end.
    pub(crate) public_url: Option<String>,
}

/// The latest earthquake of a structure.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Earthquake {
    /// Name of its report.
    pub(crate) report: String,
    /// Time of its first strong motion, ns since the Unix epoch, UTC.
    pub(crate) time_ns: i64,
}

/// Time after an earthquake during which alerts are connected with it: until its last usual report
/// (ns).
const CONNECTED_NS: i64 = 86_400_000_000_000;
/// An alert may be decided on frames shortly before the strong motion is recognised (ns).
const BEFORE_NS: i64 = 60_000_000_000;

/// The state of a structure at the moment of a report.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Scene<'s> {
    pub(crate) facts: &'s Facts,
    pub(crate) alerts: &'s BTreeMap<Name, AlertMessage>,
    /// Last report on the monitoring. `None` if the alert service is silent.
    pub(crate) monitoring: Option<&'s MonitoringDisplay>,
    pub(crate) origin: Origin,
    /// Present verdict on the fit.
    pub(crate) fit: Option<FitVerdict>,
    /// Nodes that were present before and are not any longer.
    pub(crate) absent: &'s BTreeSet<Name>,
    /// The latest earthquake.
    pub(crate) earthquake: Option<&'s Earthquake>,
}

impl Scene<'_> {
    /// Composes the content of a report.
    pub(crate) fn compose(&self, report: Report) -> Content {
        let mut advice = advice(&report, self);
        if let Report::Alert(alert) = &report {
            advice += &self.earthquake_report(alert);
        }
        let (part, moment_ns) = match &report {
            Report::Alert(alert) => (Some(&alert.parameter), Some(alert.time_ns)),
            Report::Monitoring(display) => (None, display.measured_ns),
            Report::Summary(_) => (None, None),
            Report::Judgement(display) => (Some(&display.quantity), display.epoch_ns),
            Report::Earthquake(event) => (None, Some(event.time_ns)),
            Report::Clock(_) => (None, None),
        };
        // A judgement rests on all samples since the commissioning.
        let origin = match &report {
            Report::Judgement(display) if !display.measured && self.origin == Origin::Measured => {
                Origin::Replayed
            }
            _ => self.origin,
        };
        // The verdict at the deciding frame, with its reasons, precedes the present one.
        let fit = match &report {
            Report::Alert(alert) if alert.fit.is_some() => alert.fit.zip(Some(alert.fit_reasons)),
            _ => self.fit.zip(Some(FitReasons::default())),
        };
        let circumstances = Circumstances {
            fit: fit
                .map(|(verdict, reasons)| fit_in_words(verdict, reasons))
                .unwrap_or_default(),
            title: self.facts.title.clone(),
            place: self.facts.place.clone(),
            quality: self.quality(),
            others: self.others(part),
            origin,
            advice,
            link: match &report {
                Report::Earthquake(event) => self.link_to_report(&event.subject),
                _ => self.link(part, moment_ns),
            },
            ..Circumstances::default()
        };
        Content::new(report, circumstances)
    }

    /// Returns where the report of an earthquake is that may have caused an alert. Empty without
    /// one.
    fn earthquake_report(&self, alert: &AlertMessage) -> String {
        let is_connected = |quake: &&Earthquake| {
            let after_ns = alert.time_ns.saturating_sub(quake.time_ns);
            (-BEFORE_NS..=CONNECTED_NS).contains(&after_ns)
        };
        let Some(quake) = self.earthquake.filter(is_connected) else {
            return String::new();
        };
        let base = self.facts.public_url.as_deref().unwrap_or_default();
        let path = ReportPage::path(self.facts.structure.as_str(), &quake.report);
        format!(
            " The report of the earthquake is at {base}{path} within a minute after the motion."
        )
    }

    /// Returns the address of a report. Empty without a public address.
    fn link_to_report(&self, report: &str) -> String {
        let path = ReportPage::path(self.facts.structure.as_str(), report);
        let base = self.facts.public_url.as_ref();
        base.map_or_else(String::new, |base| format!("{base}{path}"))
    }

    fn quality(&self) -> String {
        if !self.facts.has_alert_service {
            return String::new();
        }
        let Some(display) = self.monitoring else {
            return "unknown: the alert service sends no report".to_owned();
        };
        let mut channels: Vec<&ChannelMonitoring> = display.channels.iter().collect();
        if channels.is_empty() {
            return display.words();
        }
        channels.sort_by(|one, other| one.used_share.total_cmp(&other.used_share));
        let share = |channel: &&ChannelMonitoring| {
            format!("{} {:.0} %", channel.channel, 100.0 * channel.used_share)
        };
        let shown: Vec<String> = channels.iter().take(MOST_LISTED).map(share).collect();
        let more = match channels.len().saturating_sub(MOST_LISTED) {
            0 => String::new(),
            more => format!(" and {more} channels with a larger share"),
        };
        let words = display.words();
        format!(
            "{words}; samples used in the last 5 s: {}{more}",
            shown.join(", ")
        )
    }

    fn others(&self, part: Option<&Name>) -> Vec<String> {
        let is_notable = |alert: &&AlertMessage| {
            Some(&alert.parameter) != part
                && (NoticeState::from(alert.state).is_open() || alert.stands())
        };
        let mut others: Vec<&AlertMessage> = self.alerts.values().filter(is_notable).collect();
        others.sort_by_key(|alert| !alert.stands());
        let line = |alert: &&AlertMessage| {
            format!(
                "{} {}: {}",
                alert.parameter,
                alert.state.as_str(),
                alert.why
            )
        };
        let mut lines: Vec<String> = others.iter().take(MOST_LISTED).map(line).collect();
        if let Some(more) = others
            .len()
            .checked_sub(MOST_LISTED)
            .filter(|more| *more > 0)
        {
            lines.push(format!("{more} more"));
        }
        lines
    }

    /// Returns the address of the page of the structure, with the part and the moment.
    fn link(&self, part: Option<&Name>, moment_ns: Option<i64>) -> String {
        let Some(base) = &self.facts.public_url else {
            return String::new();
        };
        let part = part.map(|part| format!("parameter={part}"));
        // The page shows no moment of a record without dates.
        let moment_ns = moment_ns.filter(|moment_ns| !is_without_date(*moment_ns));
        let moment =
            moment_ns.map(|ns| format!("at={}.{:03}", ns / 1_000_000_000, ns / 1_000_000 % 1_000));
        let query: Vec<String> = part.into_iter().chain(moment).collect();
        let mark = if query.is_empty() { "" } else { "?" };
        let structure = &self.facts.structure;
        format!("{base}/#/structure/{structure}{mark}{}", query.join("&"))
    }
}

pub(crate) fn iso_8601(time_ns: i64) -> String {
    let time = jiff::Timestamp::from_nanosecond(i128::from(time_ns));
    // The calendar of `jiff` includes every time of 64 bits in nanoseconds.
    time.map_or_else(|_| time_ns.to_string(), |time| time.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{alert, monitoring, name};
    use spandrel_bus::AlertState;

    #[test]
    fn notice_of_an_alert_in_an_earthquake_links_to_its_report() {
        let (quake_s, day_s) = (1_700_000_000_i64, 86_400);
        let advice = |alert_s: i64| {
            let facts = Facts {
                structure: name("house"),
                title: String::new(),
                place: String::new(),
                contact: String::new(),
                runbook: String::new(),
                parameters: Vec::new(),
                channels: Vec::new(),
                has_alert_service: true,
                public_url: Some("https://bridge.example".to_owned()),
            };
            let quake = Earthquake {
                report: "2023-11-14t22-13-20z".to_owned(),
                time_ns: quake_s * 1_000_000_000,
            };
            let scene = Scene {
                facts: &facts,
                alerts: &BTreeMap::new(),
                monitoring: None,
                origin: Origin::Measured,
                fit: None,
                absent: &BTreeSet::new(),
                earthquake: Some(&quake),
            };
            let mut raised = alert(5, AlertState::Raised);
            raised.time_ns = alert_s * 1_000_000_000;
            let content = scene.compose(Report::Alert(raised));
            content.circumstances.advice
        };
        let link = "https://bridge.example/events/house/2023-11-14t22-13-20z.html";
        assert!(
            advice(quake_s + 5).contains(link),
            "{}",
            advice(quake_s + 5)
        );
        assert!(advice(quake_s + day_s - 5).contains(link));
        for without in [quake_s - 3600, quake_s + day_s + 5] {
            assert!(!advice(without).contains("/events/"), "{}", advice(without));
        }
    }

    #[test]
    fn notice_of_a_report_says_how_urgent_it_is_and_links_to_it() {
        let event = Event {
            structure: name("house"),
            time_ns: 1_700_000_000_000_000_000,
            kind: spandrel_bus::EventKind::EarthquakeReport,
            subject: "2023-11-14t22-13-20z".to_owned(),
            what: "earthquake report: inspect first".to_owned(),
            why: "storey-2 has lost 12 %. /events/house/2023-11-14t22-13-20z.html".to_owned(),
        };
        let content = compose(Report::Earthquake(event), &[], Some("https://a.example"));
        assert_eq!(content.state(), Some(NoticeState::EarthquakeReport));
        assert!(!content.is_open());
        assert_eq!(
            content.circumstances.link,
            "https://a.example/events/house/2023-11-14t22-13-20z.html"
        );
        let line = content.line();
        assert!(
            line.contains("20Z earthquake report: inspect first"),
            "{line}"
        );
    }

    fn compose(report: Report, alerts: &[AlertMessage], public_url: Option<&str>) -> Content {
        let facts = Facts {
            structure: name("house"),
            title: "House by the lake".to_owned(),
            place: "Lake Road 4".to_owned(),
            contact: String::new(),
            runbook: String::new(),
            parameters: Vec::new(),
            channels: vec![("roof-node".to_owned(), vec!["roof".to_owned()])],
            has_alert_service: true,
            public_url: public_url.map(str::to_owned),
        };
        let of = |alert: &AlertMessage| (alert.parameter.clone(), alert.clone());
        Scene {
            facts: &facts,
            alerts: &alerts.iter().map(of).collect(),
            monitoring: Some(&monitoring(
                9,
                MonitoringState::Degraded,
                5,
                &["a part of roof"],
            )),
            origin: Origin::Measured,
            fit: Some(FitVerdict::Supported),
            absent: &BTreeSet::new(),
            earthquake: None,
        }
        .compose(report)
    }

    #[test]
    fn a_judgement_that_contains_replayed_samples_is_not_measured() {
        let origin = |measured| {
            let sample = crate::samples::samples("house").pop().unwrap();
            let Report::Judgement(mut display) = sample.report else {
                panic!("{sample:?}")
            };
            display.measured = measured;
            compose(Report::Judgement(display), &[], None)
                .circumstances
                .origin
        };
        assert_eq!(
            [origin(true), origin(false)],
            [Origin::Measured, Origin::Replayed]
        );
    }

    #[test]
    fn link_contains_structure_part_and_time() {
        let raised = AlertMessage {
            time_ns: 1_795_220_273_536_294_717,
            ..alert(0, AlertState::Raised)
        };
        let base = Some("https://site.example");
        let content = compose(Report::Alert(raised), &[], base);
        assert_eq!(
            content.circumstances.link,
            "https://site.example/#/structure/house?parameter=storey-2&at=1795220273.536"
        );
        let without_date = compose(Report::Alert(alert(20, AlertState::Raised)), &[], base);
        assert!(
            without_date
                .circumstances
                .link
                .ends_with("house?parameter=storey-2")
        );
        let blind = monitoring(9, MonitoringState::Blind, 5, &["x"]);
        let blind = compose(Report::Monitoring(blind), &[], base);
        assert_eq!(
            blind.circumstances.link,
            "https://site.example/#/structure/house"
        );
        let none = compose(Report::Alert(alert(20, AlertState::Raised)), &[], None);
        assert_eq!(none.circumstances.link, "");
    }

    #[test]
    fn content_names_the_data_quality_and_other_alerts() {
        let own = alert(20, AlertState::Raised);
        let of = |part: &str, state| AlertMessage {
            parameter: name(part),
            ..alert(20, state)
        };
        let alerts = [
            own.clone(),
            of("storey-1", AlertState::Pending),
            of("storey-3", AlertState::Raised),
            of("storey-4", AlertState::Normal),
        ];
        let Circumstances {
            fit,
            quality,
            others,
            title,
            place,
            ..
        } = compose(Report::Alert(own), &alerts, None).circumstances;
        assert_eq!(
            quality,
            "degraded: a part of roof; samples used in the last 5 s: roof 33 %"
        );
        let states: Vec<&str> = others
            .iter()
            .map(|line| line.split(':').next().unwrap())
            .collect();
        assert_eq!(states, ["storey-3 raised", "storey-1 pending"]);
        assert_eq!((&*title, &*place), ("House by the lake", "Lake Road 4"));
        assert_eq!(fit, "the data support the model");
        let doubtful = AlertMessage {
            fit: Some(FitVerdict::Doubtful),
            ..alert(20, AlertState::Raised)
        };
        let own = compose(Report::Alert(doubtful), &[], None)
            .circumstances
            .fit;
        assert_eq!(
            own,
            fit_in_words(FitVerdict::Doubtful, FitReasons::default())
        );
    }
}
