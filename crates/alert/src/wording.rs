//! Describes an alert in words: parameter, loss, probability and start.

use jiff::Timestamp;
use spandrel_bus::{
    AlertState, FitVerdict, RoundedProbability, UndecidedBecause, fit_in_words, per_cent, per_cents,
};

use crate::motion::Shaking;
use crate::{Alert, LossEstimate, ParameterEstimate, ReferenceRule, Rule, Subject};

/// Reason of a doubt about the sensors if none of them is named.
pub(crate) const SENSORS_DISAGREE: &str = "the sensors measure different motions: their motion is \
                                           too weak to compare, or a sensor is faulty";

/// Why nothing is decided without samples of the structure.
pub(crate) const RESPONSE_IS_SILENT: &str = "no sensor of the response delivers usable samples";

/// The context of an alert, for its text.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Before<'a> {
    /// The last announced alert.
    pub(crate) alert: Option<&'a Alert>,
    /// The last estimate. It explains why nothing is decided, even if an unconfirmed alert states
    /// an earlier one.
    pub(crate) now: ParameterEstimate,
    /// Whether no sensor of the response delivers samples.
    pub(crate) is_silent: bool,
    /// Whether the estimate counts as less certain because a sensor is left out.
    pub(crate) is_without_sensor: bool,
    /// The strong motion from which the structure has not settled.
    pub(crate) shaking: Option<&'a Shaking>,
    /// The modes that contradict the model, in words.
    pub(crate) modes: Option<&'a str>,
}

/// Returns the decision in words. Ignores `alert.why`.
pub(crate) fn describe(
    subject: &Subject,
    rule: &Rule,
    alert: &Alert,
    before: Before<'_>,
) -> String {
    let name = &subject.name;
    let undecided = |because| undecided(because, rule, alert, before);
    if let (AlertState::Undecided, Some(because)) = (alert.state, alert.undecided_because) {
        return format!("no decision on {name}: {}", undecided(because));
    }
    let (Some(loss), Some(reference)) = (&alert.loss, &alert.reference) else {
        return format!("reference of {name} is being learnt");
    };
    let parts = Parts::of(subject, rule, alert, loss, before);
    let Parts {
        how_much,
        how_sure,
        of_rule,
        since,
        ..
    } = &parts;
    let found = alert.probability_of_loss;
    let ends = match found < rule.clear_credibility() {
        true => format!(
            "; the alert will clear if this lasts for {}",
            duration(rule.sustain_ns())
        ),
        false => String::new(),
    };
    match alert.state {
        AlertState::Learning | AlertState::Normal | AlertState::Undecided => format!(
            "{name} is normal against {:.3} ± {:.3}: loss {how_much}, {of_rule}",
            reference.mean(),
            reference.std()
        ),
        AlertState::Pending => format!(
            "{name} seems to have lost {how_much}, {of_rule}{since}; the alert will be raised if \
             this lasts for {}{}",
            duration(rule.sustain_ns()),
            if alert.follows_jump {
                "; a sudden change is still being followed"
            } else {
                ""
            }
        ),
        AlertState::SofteningInMotion => format!(
            "{name} is softer by {how_much}, {of_rule}{since}, {}; this alone shows no damage; a \
             lasting loss is judged from weak motion, 5 minutes after the strong motion",
            before
                .shaking
                .map_or_else(|| "in strong motion".to_owned(), in_motion)
        ),
        AlertState::Unconfirmed => unconfirmed(&parts, rule, alert, before),
        // A raised alert needs the required probability only once.
        AlertState::Raised => format!("{name} has lost {how_much}, {how_sure}{since}{ends}"),
        AlertState::Acknowledged => {
            format!(
                "{name} has lost {how_much}, {how_sure}{since}{ends}; {}",
                acknowledged(alert)
            )
        }
        AlertState::Cleared if alert.undecided_because.is_some() => format!(
            "the alert of {name} was cleared; no new decision: {}",
            alert.undecided_because.map(undecided).unwrap_or_default()
        ),
        AlertState::Cleared if found >= rule.clear_credibility() => format!(
            "a loss of more than {} in {name} was credible again, but for less than {}: loss \
             {how_much}, {of_rule}",
            percent(alert.rule_loss),
            duration(rule.sustain_ns())
        ),
        AlertState::Cleared => format!(
            "a loss of more than {} in {name} is no longer credible: loss {how_much}, {how_sure}, \
             below {} for {}",
            percent(alert.rule_loss),
            asked(rule.clear_credibility()),
            duration(rule.sustain_ns())
        ),
    }
}

/// Parts of the sentence about an alert with a loss.
struct Parts<'a> {
    /// Name of the parameter.
    name: &'a str,
    /// The loss with its intervals.
    how_much: String,
    /// The probability that the loss exceeds the one of the rule.
    how_sure: String,
    /// The same probability, with the value of the rule if it is below that.
    of_rule: String,
    /// The start of the loss after a comma. Empty if there is none.
    since: String,
}

impl<'a> Parts<'a> {
    fn of(
        subject: &'a Subject,
        rule: &Rule,
        alert: &Alert,
        loss: &LossEstimate,
        before: Before<'_>,
    ) -> Self {
        let Subject { name, quantity, .. } = subject;
        // A normal or cleared state claims no loss that could still fall.
        let has_lost = !matches!(alert.state, AlertState::Normal | AlertState::Cleared);
        let follows = alert.follows_jump && alert.undecided_because.is_none();
        let how_much = match has_lost && follows {
            true => followed(quantity, loss, alert, before.alert),
            false => {
                let (lost, intervals) = with_intervals(loss.loss, loss, alert);
                format!("{lost} of its {quantity} ({intervals})")
            }
        };
        let found = alert.probability_of_loss;
        let told = RoundedProbability::new(found, &[rule.credibility(), rule.clear_credibility()]);
        let how_sure = format!(
            "more than {} with probability {told}",
            percent(alert.rule_loss)
        );
        // If the probability is too low, the text contains the rule's value.
        let of_rule = if found < rule.credibility() {
            format!("{how_sure} ({} required)", asked(rule.credibility()))
        } else {
            how_sure.clone()
        };
        let since = alert
            .since_ns
            .map(|time_ns| format!(", since {}", time(time_ns)))
            .unwrap_or_default();
        Self {
            name,
            how_much,
            how_sure,
            of_rule,
            since,
        }
    }
}

/// Returns the decision about an unconfirmed alert in words.
fn unconfirmed(parts: &Parts<'_>, rule: &Rule, alert: &Alert, before: Before<'_>) -> String {
    let Parts {
        name,
        how_much,
        of_rule,
        since,
        ..
    } = parts;
    let seen = if alert.acknowledgement.is_some() {
        format!("; {}", acknowledged(alert))
    } else {
        String::new()
    };
    let undecided = |because| undecided(because, rule, alert, before);
    match alert.undecided_because {
        // The last decided estimate did not show the loss any more.
        Some(because) if alert.probability_of_loss < rule.credibility() => format!(
            "{name} had an alert{since}; not confirmed now: {}; the last decided estimate shows a \
             loss of {how_much}, {of_rule}{seen}",
            undecided(because)
        ),
        Some(because) => format!(
            "{name} had lost {how_much}, {of_rule}{since}; not confirmed now: {}{seen}",
            undecided(because)
        ),
        None => format!(
            "{name} had an alert{since} that the data do not confirm: loss now {how_much}, \
             {of_rule}{seen}; the alert will clear if this lasts for {}",
            duration(rule.sustain_ns())
        ),
    }
}

/// Returns the strong motion in words, and whether it explains the softening.
fn in_motion(shaking: &Shaking) -> String {
    let peak = shaking.peak_m_per_s2;
    let explained = match shaking.expected {
        None => "whether this amplitude explains it is not known yet".to_owned(),
        Some(expected) => {
            let verdict = match expected.is_as_expected {
                true => "as expected at this amplitude",
                false if expected.deviations < 0.0 => "more than expected at this amplitude",
                false => "less than expected at this amplitude",
            };
            let earlier = match expected.events {
                1 => "one earlier motion".to_owned(),
                events => format!("{events} earlier motions"),
            };
            format!("{verdict}, by {earlier}")
        }
    };
    format!("in strong motion of up to {peak:.2} m/s²: {explained}")
}

/// Returns the reason why nothing is decided, including the reasons for a contradicted fit.
fn undecided(because: UndecidedBecause, rule: &Rule, alert: &Alert, before: Before<'_>) -> String {
    match because {
        UndecidedBecause::FitContradicted => {
            let words = fit_in_words(FitVerdict::Contradicted, alert.fit_reasons);
            let modes = before.modes;
            modes.map_or_else(|| words.clone(), |modes| format!("{words} ({modes})"))
        }
        UndecidedBecause::NothingLearnt if before.is_silent => {
            let ParameterEstimate { mean, std, .. } = before.now;
            format!("{RESPONSE_IS_SILENT} (last estimate {mean:.3} ± {std:.3})")
        }
        UndecidedBecause::NothingLearnt => nothing_learnt(rule, alert, before),
        UndecidedBecause::NoiseTraining
        | UndecidedBecause::ExcitationSilent
        | UndecidedBecause::SensorInDoubt
        | UndecidedBecause::ParameterAtBound => {
            let ParameterEstimate { mean, std, .. } = before.now;
            format!("{} (estimate {mean:.3} ± {std:.3})", because.words())
        }
    }
}

/// Returns whether the estimate or the reference is too uncertain.
///
/// The reference is the cause if it would hide the loss even from an exact estimate.
fn nothing_learnt(rule: &Rule, alert: &Alert, before: Before<'_>) -> String {
    let ParameterEstimate { mean, std, .. } = before.now;
    let Some(reference) = &alert.reference else {
        let span = match rule.reference() {
            ReferenceRule::Learnt { span_ns } => format!(" of {}", duration(span_ns)),
            ReferenceRule::Given(_) => String::new(),
        };
        return format!(
            "the estimate was too uncertain for a reference during a span{span}, so the reference \
             is being learnt again (estimate {mean:.3} ± {std:.3})"
        );
    };
    let twice = (2.0 * alert.rule_loss).min(1.0);
    let best = reference.largest_credible(alert.rule_loss, alert.rule_credibility);
    let is_estimate = best.is_some_and(|largest| largest >= (1.0 - twice) * reference.mean());
    let what = match (is_estimate, reference.scatter()) {
        (true, _) => "the estimate is",
        (false, Some(_)) => "the reference, from few records, is",
        (false, None) => "the reference is",
    };
    let why = match before.is_without_sensor {
        true => ", because a sensor is left out",
        false => "",
    };
    let shown = format!("a loss of {}{why}", percent(twice));
    let (sound, scatter) = (reference.mean(), reference.std());
    format!(
        "{what} too uncertain to show {shown} (estimate {mean:.3} ± {std:.3}, reference \
         {sound:.3} ± {scatter:.3})"
    )
}

/// Returns a loss that is still changing in words, with its lower limit.
fn followed(quantity: &str, loss: &LossEstimate, alert: &Alert, before: Option<&Alert>) -> String {
    let has_risen = before
        .is_some_and(|before| before.follows_jump && before.estimate.mean < alert.estimate.mean);
    let moves = if has_risen { "moving" } else { "falling" };
    let (least, intervals) = with_intervals(loss.low.max(0.0), loss, alert);
    format!("at least {least} of its {quantity}, still {moves} ({intervals})")
}

/// The reason why an alert ends without a new measurement.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum End {
    /// The structure file does not contain the parameter.
    NoSuchParameter,
    /// No rule watches the parameter.
    Unwatched,
    /// The rule has changed, and the last estimate does not satisfy it.
    RuleChanged {
        from: Rule,
        to: Rule,
        probability: f64,
    },
    /// The rule and the model have changed, so no estimate exists that the rule could apply to.
    RuleAndModelChanged,
    /// The reference of the loss is unknown, because it is learnt again.
    ReferenceRelearnt,
}

/// Returns the end of an alert in words.
pub(crate) fn describe_end(subject: &Subject, end: &End) -> String {
    let name = &subject.name;
    let why = match end {
        End::NoSuchParameter => "the structure file no longer contains the parameter".to_owned(),
        End::Unwatched => "the structure file no longer contains a rule for it".to_owned(),
        End::RuleChanged {
            from,
            to,
            probability: found,
        } => {
            let found = RoundedProbability::new(*found, &[from.credibility(), to.credibility()]);
            let reference_changed = from.reference() != to.reference();
            let requirement_of = |rule: &Rule| {
                let counted = if reference_changed {
                    counted_from(rule.reference())
                } else {
                    String::new()
                };
                let (loss, credibility) = (percent(rule.loss()), asked(rule.credibility()));
                format!(
                    "more than {loss}{counted} with probability {credibility} for {}",
                    duration(rule.sustain_ns())
                )
            };
            let (from, to) = (requirement_of(from), requirement_of(to));
            format!(
                "its rule changed from {from} to {to}; the probability of that loss by the last \
                 estimate is {found}"
            )
        }
        End::RuleAndModelChanged => {
            "its rule and the model in the structure file changed, and identification restarts"
                .to_owned()
        }
        End::ReferenceRelearnt => {
            "its reference is being learnt again because the rule or the model changed".to_owned()
        }
    };
    format!("alert of {name} has ended: {why}")
}

/// Returns the reference of a loss as a suffix to the loss.
fn counted_from(reference: ReferenceRule) -> String {
    match reference {
        ReferenceRule::Given(given) if given.std() == 0.0 => format!(" below {:.3}", given.mean()),
        ReferenceRule::Given(given) => format!(" below {:.3} ± {:.3}", given.mean(), given.std()),
        ReferenceRule::Learnt { span_ns } => {
            format!(" below a reference learnt in {}", duration(span_ns))
        }
    }
}

/// Maximum length of a quoted name or note, in characters.
const LONGEST_QUOTE: usize = 400;

fn acknowledged(alert: &Alert) -> String {
    let Some(acknowledged) = &alert.acknowledgement else {
        return "acknowledged".to_owned();
    };
    let quote = |text: &str| text.chars().take(LONGEST_QUOTE).collect::<String>();
    if acknowledged.note.is_empty() {
        return format!("acknowledged by {}", quote(&acknowledged.who));
    }
    format!(
        "acknowledged by {}: {}",
        quote(&acknowledged.who),
        quote(&acknowledged.note)
    )
}

/// Formats a share in per cent, with one decimal unless it is whole: `14.2 %`, `5 %`.
fn percent(share: f64) -> String {
    format!("{} %", per_cent(share))
}

/// Returns a loss, and the interval of the loss with the interval within this record if the
/// reference has an estimated scatter. All have the same number of decimals.
fn with_intervals(lost: f64, loss: &LossEstimate, alert: &Alert) -> (String, String) {
    let has_scatter = alert
        .reference
        .is_some_and(|reference| reference.scatter().is_some());
    match alert.loss_within_record().filter(|_| has_scatter) {
        Some(within) => {
            let [lost, low, high, least, most] =
                per_cents([lost, loss.low, loss.high, within.low, within.high]);
            let intervals = format!(
                "95 % interval for this structure {low} to {high} %, within this record {least} \
                 to {most} %"
            );
            (format!("{lost} %"), intervals)
        }
        None => {
            let [lost, low, high] = per_cents([lost, loss.low, loss.high]);
            (
                format!("{lost} %"),
                format!("95 % interval {low} to {high} %"),
            )
        }
    }
}

/// Formats a probability as specified in the rule, with at least three decimals.
fn asked(probability: f64) -> String {
    let rounded = format!("{probability:.3}");
    if rounded.parse() == Ok(probability) {
        rounded
    } else {
        probability.to_string()
    }
}

fn duration(span_ns: i64) -> String {
    format!("{} s", span_ns as f64 / 1e9)
}

/// Formats a time: in seconds for a record that starts at 0, otherwise as a UTC date.
fn time(time_ns: i64) -> String {
    /// Three years. No record that starts at 0 is longer, and no clock is so far behind.
    const RECORD_NS: i64 = 100_000_000_000_000_000;
    match Timestamp::from_nanosecond(i128::from(time_ns)) {
        Ok(calendar) if time_ns.abs() >= RECORD_NS => {
            calendar.strftime("%Y-%m-%d %H:%M:%S UTC").to_string()
        }
        _ => format!("{:.2} s", time_ns as f64 / 1e9),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn required_credibility_is_not_rounded() {
        assert_eq!([0.99, 0.5, 0.9999].map(asked), ["0.990", "0.500", "0.9999"]);
    }

    #[test]
    fn times_of_records_are_in_seconds_and_times_of_clocks_are_dates() {
        assert_eq!(time(61_200_000_000), "61.20 s");
        assert_eq!(time(1_709_208_000_000_000_001), "2024-02-29 12:00:00 UTC");
    }
}
