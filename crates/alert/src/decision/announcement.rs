//! The alerts of a decision, and revisions of raised alerts.

use super::Decision;
use crate::credibility::{loss_as_modelled, loss_estimate, probability_of_loss};
use crate::wording::{Before, describe};
use crate::{Alert, ParameterEstimate};
use spandrel_bus::{AlertState, EstimateFlags, Phase, losses_agree};

/// Minimum time between revisions of a raised alert, ns of measurement time.
const REVISED_EVERY_NS: i64 = 1_000_000_000;

impl Decision {
    pub(super) fn announce(&mut self, alerts: &mut Vec<Alert>) {
        if let Some(alert) = self.alert(self.state()) {
            self.last_alert = Some(alert.clone());
            alerts.push(alert);
        }
    }

    /// Announces a raised alert again if its loss has changed, or if a sudden change has ended.
    pub(super) fn revise(&mut self, alerts: &mut Vec<Alert>) {
        let (Some(last), Some((estimate, flags))) = (&self.last_alert, self.last) else {
            return;
        };
        let Some(reference) = self.reference() else {
            return; // no alert is raised before the reference is known
        };
        let is_raised = matches!(last.state, AlertState::Raised | AlertState::Acknowledged);
        let is_due = estimate.time_ns.saturating_sub(last.estimate.time_ns) >= REVISED_EVERY_NS;
        if !is_raised || !is_due {
            return;
        }
        let now = loss_as_modelled(&estimate, &reference);
        let told = last
            .reference
            .map(|reference| loss_as_modelled(&last.estimate, &reference));
        let is_seen = last.state == AlertState::Acknowledged;
        if let Some(told) = told.filter(|_| is_seen) {
            // The first revision after the acknowledgement is still to come.
            let seen = *self.acknowledged_up_to.get_or_insert(told.high);
            if now.low > seen && !flags.follows_jump {
                self.forget_acknowledgement(alerts);
                return;
            }
        }
        let has_jumped = last.follows_jump && !flags.follows_jump;
        let has_moved = told.is_none_or(|told| {
            !losses_agree((told.loss, told.interval()), (now.loss, now.interval()))
        });
        if has_jumped || has_moved {
            self.announce(alerts);
        }
    }

    /// Announces an undecided state again if its estimate has changed by more than its standard
    /// deviation, or is twice or half as certain.
    pub(super) fn revise_undecided(&mut self, alerts: &mut Vec<Alert>) {
        let (Some(last), Some((now, _))) = (&self.last_alert, &self.last) else {
            return;
        };
        let told = &last.estimate;
        let is_due = now.time_ns.saturating_sub(told.time_ns) >= REVISED_EVERY_NS;
        let has_moved = (now.mean - told.mean).abs() > now.std.max(told.std)
            || now.std > 2.0 * told.std
            || told.std > 2.0 * now.std;
        if last.state == AlertState::Undecided && is_due && has_moved {
            self.announce(alerts);
        }
    }

    /// Announces softening again when the strong motion has ended, because its amplitude is now
    /// known.
    pub(super) fn revise_softening(&mut self, has_calmed: bool, alerts: &mut Vec<Alert>) {
        let last = self.last_alert.as_ref();
        let is_soft = last.is_some_and(|last| last.state == AlertState::SofteningInMotion);
        if has_calmed && is_soft {
            self.announce(alerts);
        }
    }

    /// Returns the alert for `state` at the last estimate.
    pub(super) fn alert(&self, state: AlertState) -> Option<Alert> {
        let (estimate, flags) = self.announced_estimate(state)?;
        let reference = self.reference();
        let mut alert = Alert {
            rule: self.rule_number,
            parameter: self.subject.parameter,
            state,
            estimate,
            since_ns: self.since_ns(),
            rule_loss: self.rule.loss(),
            rule_credibility: self.rule.credibility(),
            probability_of_loss: reference.map_or(0.0, |reference| {
                probability_of_loss(&estimate, &reference, self.rule.loss())
            }),
            reference,
            loss: reference.map(|reference| loss_estimate(&estimate, &reference)),
            acknowledgement: self.acknowledgement().cloned(),
            why: String::new(),
            fit: flags.fit,
            fit_reasons: flags.fit_reasons,
            follows_jump: flags.follows_jump,
            undecided_because: self.undecided_because(),
            revision: 0,
        };
        alert.revision = self
            .last_alert
            .as_ref()
            .filter(|last| alert.is_same_state(last))
            .map_or(0, |last| last.revision + 1);
        let limit = self.strong_m_per_s2.zip(reference);
        let shaking = limit.and_then(|(limit, reference)| self.motion.shaking(&reference, limit));
        let before = Before {
            alert: self.last_alert.as_ref(),
            now: self.last.map_or(estimate, |(now, _)| now),
            is_silent: self
                .last
                .is_some_and(|(_, flags)| flags.phase == Phase::ResponseSilent),
            is_without_sensor: self.left_out.widens(),
            shaking: shaking.as_ref(),
            modes: self.contradicting_modes.as_deref(),
        };
        alert.why = describe(&self.subject, &self.rule, &alert, before);
        Some(alert)
    }

    /// Returns the estimate for an alert in `state`.
    ///
    /// This is the last estimate. For an unconfirmed alert without a decision, it is the last
    /// announced estimate, with the present time.
    fn announced_estimate(&self, state: AlertState) -> Option<(ParameterEstimate, EstimateFlags)> {
        let (estimate, flags) = self.last?;
        let is_unsupported = state == AlertState::Unconfirmed && self.undecided_because().is_some();
        let told = self
            .last_alert
            .as_ref()
            .filter(|last| is_unsupported && last.since_ns == self.since_ns());
        let told = told.map_or(estimate, |last| ParameterEstimate {
            time_ns: estimate.time_ns,
            ..last.estimate
        });
        Some((told, flags))
    }
}
