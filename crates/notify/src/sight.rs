//! Decides when the monitoring of a structure is worth a notice: once it has been blind or degraded
//! for a time, and once it is watching again. It has no clock: the time is an argument.

use crate::origin::Origin;
use crate::settings::Delays;
use serde::{Deserialize, Serialize};
use spandrel_bus::{MonitoringDisplay, MonitoringState as State, Name};
use std::time::Duration;

/// Silence of the alert service after which a structure is blind. The service reports each second.
const SILENT_AFTER: Duration = Duration::from_secs(5);

/// The monitoring of one structure, as reported and as notified.
#[derive(Debug)]
pub(crate) struct Sight {
    structure: Name,
    delays: Delays,
    /// Last report and its arrival time.
    heard: Option<(MonitoringDisplay, Duration)>,
    /// Start of this run.
    started: Duration,
    /// Present state, and the time since which it has lasted. `None` while references are learnt.
    state: Option<(State, Duration)>,
    /// Time since which the structure has not been watched.
    impaired: Option<Duration>,
    pub(crate) told: Told,
}

/// The state of the last notice, unless it was `watching`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Told {
    /// While the samples were measured.
    measured: Option<State>,
    /// While the samples came from the present recording or simulation.
    other: Option<State>,
}

impl Told {
    /// Forgets the former recording or simulation, after the origin of the samples has changed.
    pub(crate) fn change_origin(&mut self) {
        self.other = None;
    }

    fn of(&mut self, origin: Origin) -> &mut Option<State> {
        match origin {
            Origin::Measured => &mut self.measured,
            Origin::Replayed | Origin::Simulated => &mut self.other,
        }
    }
}

impl Sight {
    pub(crate) fn new(structure: Name, delays: Delays, now: Duration) -> Self {
        Self {
            structure,
            delays,
            heard: None,
            started: now,
            state: None,
            impaired: None,
            told: Told::default(),
        }
    }

    /// Stores a report of the alert service.
    pub(crate) fn take(&mut self, report: MonitoringDisplay, now: Duration) {
        let state = (!report.only_learns()).then_some(report.state);
        let lasted_ns = report.time_ns.saturating_sub(report.since_ns).max(0);
        let since = now.saturating_sub(Duration::from_nanos(lasted_ns.unsigned_abs()));
        self.heard = Some((report, now));
        self.enter(state, since);
    }

    /// Returns the last report, or `None` if the alert service is silent.
    pub(crate) fn report(&self, now: Duration) -> Option<&MonitoringDisplay> {
        let (report, at) = self.heard.as_ref()?;
        (now.saturating_sub(*at) <= SILENT_AFTER).then_some(report)
    }

    /// Returns the measurement time of the last reported estimate, ns since the Unix epoch, UTC.
    pub(crate) fn measured_ns(&self) -> Option<i64> {
        self.heard.as_ref()?.0.measured_ns
    }

    /// Returns the report for a notice about samples of this origin, if one is due. `wall_ns` is
    /// the wall-clock time, ns since the Unix epoch, UTC.
    pub(crate) fn look(
        &mut self,
        origin: Origin,
        now: Duration,
        wall_ns: i64,
    ) -> Option<MonitoringDisplay> {
        if now.saturating_sub(self.started) <= SILENT_AFTER {
            return None; // what the bus knows has not arrived yet
        }
        if self.report(now).is_none() {
            let last = self.heard.as_ref().map_or(self.started, |(_, at)| *at);
            self.enter(Some(State::Blind), last);
        }
        let (state, since) = self.state?;
        let lasted = |since: Duration| now.saturating_sub(since);
        let told = self.told.of(origin);
        let is_due = match (state, *told) {
            (State::Watching, told) => told.is_some() && lasted(since) >= self.delays.watching,
            (State::Blind, told) => {
                told != Some(State::Blind) && lasted(since) >= self.delays.blind
            }
            (State::Degraded, None) => {
                lasted(self.impaired.unwrap_or(since)) >= self.delays.degraded
            }
            (State::Degraded, told) => {
                told == Some(State::Blind) && lasted(since) >= self.delays.degraded
            }
        };
        if !is_due {
            return None;
        }
        *told = (state != State::Watching).then_some(state);
        Some(match self.report(now) {
            Some(report) => report.clone(),
            None => self.silence(lasted(since), wall_ns),
        })
    }

    fn enter(&mut self, state: Option<State>, since: Duration) {
        self.state = state.map(|state| match self.state {
            Some((before, start)) if before == state => (state, start),
            _ => (state, since),
        });
        self.impaired = match state {
            Some(State::Degraded | State::Blind) => self.impaired.or(Some(since)),
            Some(State::Watching) | None => None,
        };
    }

    /// Returns a report about the silence of the alert service.
    fn silence(&self, silence: Duration, wall_ns: i64) -> MonitoringDisplay {
        let silent_ns = i64::try_from(silence.as_nanos()).unwrap_or(i64::MAX);
        let reason = match self.heard {
            Some(_) => format!(
                "the alert service has sent no report for {} s",
                silence.as_secs()
            ),
            None => format!(
                "the alert service has sent no report since notify started {} s ago",
                silence.as_secs()
            ),
        };
        MonitoringDisplay {
            structure: self.structure.clone(),
            time_ns: wall_ns,
            measured_ns: self.measured_ns(),
            state: State::Blind,
            since_ns: wall_ns.saturating_sub(silent_ns),
            reasons: vec![reason],
            parameters: Vec::new(),
            channels: Vec::new(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{delays, monitoring, name, s};
    use spandrel_bus::REFERENCE_IS_LEARNT;

    /// Reports a state each second of a span, and returns the notices with their second.
    fn told(spans: &[(u64, Option<(State, &str)>)]) -> Vec<(u64, State, String)> {
        let mut sight = Sight::new(name("house"), delays(), s(0));
        let (mut second, mut told) = (0, Vec::new());
        let mut since = (None, 0);
        for (length, reported) in spans {
            for _ in 0..*length {
                if let Some((state, reason)) = reported {
                    if since.0 != Some(*state) {
                        since = (Some(*state), second);
                    }
                    let report = monitoring(second as i64, *state, since.1 as i64, &[*reason]);
                    sight.take(report, s(second));
                }
                let notice = sight.look(Origin::Measured, s(second), second as i64 * 1_000_000_000);
                told.extend(notice.map(|report| (second, report.state, report.reasons.join(";"))));
                second += 1;
            }
        }
        told
    }

    fn states(spans: &[(u64, Option<(State, &str)>)]) -> Vec<(u64, State)> {
        let told = told(spans).into_iter();
        told.map(|(second, state, _)| (second, state)).collect()
    }

    const WATCHING: Option<(State, &str)> = Some((State::Watching, ""));
    const DEGRADED: Option<(State, &str)> = Some((State::Degraded, "no samples of roof are used"));
    const BLIND: Option<(State, &str)> = Some((State::Blind, "no estimates have arrived"));

    #[test]
    fn blindness_is_reported_after_its_delay_and_its_end_once() {
        let spans = [(10, WATCHING), (100, BLIND), (100, WATCHING)];
        assert_eq!(states(&spans), [(70, State::Blind), (170, State::Watching)]);
        let short = [(10, WATCHING), (59, BLIND), (1000, WATCHING)];
        assert_eq!(states(&short), []);
    }

    #[test]
    fn each_state_has_its_own_delay() {
        let spans = [(10, WATCHING), (899, DEGRADED), (10, WATCHING)];
        assert_eq!(states(&spans), []);
        let spans = [(10, WATCHING), (2000, DEGRADED), (100, BLIND)];
        assert_eq!(
            states(&spans),
            [(910, State::Degraded), (2070, State::Blind)]
        );
        // Blindness too short for a notice of its own counts as degraded.
        let spans = [(10, WATCHING), (50, BLIND), (2000, DEGRADED)];
        assert_eq!(states(&spans), [(910, State::Degraded)]);
    }

    #[test]
    fn interruption_shorter_than_the_delay_is_one_episode() {
        let spans = [(100, BLIND), (30, WATCHING), (100, BLIND), (100, WATCHING)];
        assert_eq!(states(&spans), [(60, State::Blind), (290, State::Watching)]);
    }

    #[test]
    fn learning_a_reference_is_not_reported() {
        let learning = Some((State::Blind, REFERENCE_IS_LEARNT));
        assert_eq!(states(&[(5000, learning), (100, WATCHING)]), []);
        // Blindness during the learning counts from its own start.
        let spans = [(5000, learning), (100, BLIND)];
        assert_eq!(states(&spans).len(), 1);
    }

    #[test]
    fn silence_of_the_alert_service_is_blindness() {
        let never = told(&[(100, None)]);
        assert_eq!(never.len(), 1, "{never:?}");
        assert_eq!((never[0].0, never[0].1), (60, State::Blind));
        assert!(
            never[0].2.contains("since notify started 60 s ago"),
            "{never:?}"
        );
        let ended = told(&[(100, WATCHING), (100, None), (100, WATCHING)]);
        assert_eq!((ended[0].0, ended[0].1), (159, State::Blind));
        assert!(ended[0].2.contains("no report for 60 s"), "{ended:?}");
        assert_eq!((ended[1].0, ended[1].1), (200, State::Watching)); // the service has watched all the time
    }

    #[test]
    fn blindness_before_the_start_is_reported_after_listening_to_the_bus() {
        let mut sight = Sight::new(name("house"), delays(), s(1000));
        sight.take(monitoring(5000, State::Blind, 0, &["x"]), s(1001));
        assert_eq!(sight.look(Origin::Measured, s(1001), 0), None);
        sight.take(monitoring(5005, State::Blind, 0, &["x"]), s(1006));
        assert!(sight.look(Origin::Measured, s(1006), 0).is_some());
        // The next run has already told it.
        let mut next = Sight::new(name("house"), delays(), s(2000));
        next.told = sight.told;
        next.take(monitoring(6000, State::Blind, 0, &["x"]), s(2006));
        assert_eq!(next.look(Origin::Measured, s(2006), 0), None);
        next.take(monitoring(6001, State::Watching, 6001, &[]), s(2007));
        next.take(monitoring(6090, State::Watching, 6001, &[]), s(2096));
        assert_eq!(
            next.look(Origin::Measured, s(2096), 0)
                .map(|report| report.state),
            Some(State::Watching)
        );
    }

    #[test]
    fn replay_after_blindness_does_not_hide_its_end() {
        let mut sight = Sight::new(name("house"), delays(), s(0));
        let (blind, watching) = (State::Blind, State::Watching);
        sight.take(monitoring(100, blind, 0, &["x"]), s(100));
        let look = |sight: &mut Sight, origin, second| {
            let report = sight.look(origin, s(second), 0);
            report.map(|report| report.state)
        };
        assert_eq!(look(&mut sight, Origin::Measured, 100), Some(blind));
        sight.told.change_origin();
        sight.take(monitoring(200, watching, 101, &[]), s(200));
        assert_eq!(look(&mut sight, Origin::Replayed, 200), None);
        sight.take(monitoring(300, blind, 201, &["x"]), s(300));
        assert_eq!(look(&mut sight, Origin::Replayed, 300), Some(blind));
        sight.told.change_origin();
        assert_eq!(look(&mut sight, Origin::Measured, 300), None, "told before");
        sight.take(monitoring(400, watching, 301, &[]), s(400));
        assert_eq!(look(&mut sight, Origin::Measured, 400), Some(watching));
    }
}
