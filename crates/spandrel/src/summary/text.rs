//! The summary as text for people.

use crate::commands::counted;

use super::fit::percent;
use super::{AlertSummary, ClassSummary, DecidedSummary, NoiseLevelSummary, Samples, Summary};
use std::fmt::{self, Display, Write as _};

/// Maximum number of classes, leads and calibrations in the text. JSON contains all.
const LISTED: usize = 8;

impl Summary {
    /// Returns the summary as text for people.
    pub fn text(&self) -> String {
        let mut text = String::new();
        // Writing to a string cannot fail.
        let _ = self.write(&mut text);
        text
    }

    fn write(&self, text: &mut String) -> fmt::Result {
        writeln!(
            text,
            "{} identified",
            counted(self.frames as usize, "frame", "frames")
        )?;
        if let Some(Samples { missing, discarded }) = &self.samples {
            for (what, counts) in [("missing samples", missing), ("discarded", discarded)] {
                if !counts.is_empty() {
                    let counts: Vec<String> = counts
                        .iter()
                        .map(|(name, count)| format!("{name} {count}"))
                        .collect();
                    writeln!(text, "  {what}: {}", counts.join(", "))?;
                }
            }
        }
        if let Some(share) = self.effective_share {
            writeln!(
                text,
                "  {:.0} % of the particles counted on average",
                100.0 * share
            )?;
        }
        for (name, level) in self.parameters.iter() {
            write!(text, "  {name:<24} {:.4} ± {:.4}", level.mean, level.std)?;
            match level.for_this_structure {
                Some(interval) => writeln!(
                    text,
                    ", for this structure {:.2} to {:.2}",
                    interval.low, interval.high
                )?,
                None => writeln!(text)?,
            }
        }
        self.write_noise(text)?;
        self.write_support(text)?;
        if let Some(classes) = &self.classes {
            write_classes(classes, text)?;
        }
        for node in &self.nodes {
            writeln!(text, "  node {:<19} {}", node.node, node.words())?;
        }
        for warning in &self.warnings {
            writeln!(text, "warning: {warning}")?;
        }
        if self.alerts.is_empty() {
            text.push_str(match self.is_undecided {
                true => "no alert, but not everything was decided, see the warnings\n",
                false => "no alert\n",
            });
        }
        for alert in &self.alerts {
            write!(
                text,
                "{:>9.2} s  {}: {}",
                alert.time_s,
                alert.state.as_str(),
                alert.why
            )?;
            match loss_at_first(alert) {
                Some(loss) => writeln!(
                    text,
                    " (revised since; the loss at that time was {})",
                    percent(loss)
                )?,
                None => writeln!(text)?,
            }
        }
        Ok(())
    }

    fn write_noise(&self, text: &mut String) -> fmt::Result {
        for (name, level) in self.noise.iter() {
            let NoiseLevelSummary {
                found_std,
                stated_std,
                ratio,
                unit,
                ..
            } = level;
            let unit = if *unit == "1" {
                String::new()
            } else {
                format!(" {unit}")
            };
            writeln!(
                text,
                "  noise of {name:<15} {found_std:.3e}{unit}, {ratio:.2} times the \
                 {stated_std:.3e}{unit} of the file (standard deviations)"
            )?;
        }
        if let Some(misfit) = self.misfit {
            writeln!(
                text,
                "  normalised innovation squared {misfit:.2} per channel"
            )?;
        }
        Ok(())
    }

    fn write_support(&self, text: &mut String) -> fmt::Result {
        if let Some(fit) = &self.fit {
            writeln!(text, "  fit {}", fit.words())?;
        }
        let all: Vec<DecidedSummary> = self.decided.values().cloned().collect();
        if let Some(words) = DecidedSummary::words_of(&all) {
            return writeln!(text, "  alerts {words}");
        }
        for (name, decided) in self.decided.iter() {
            writeln!(text, "  alerts of {name:<14} {}", decided.words())?;
        }
        Ok(())
    }
}

/// Returns the loss at the time of an alert, if a revision of the alert states a different loss.
fn loss_at_first(alert: &AlertSummary) -> Option<f64> {
    /// Minimum difference to report. A smaller one is within both intervals.
    const LEAST_DIFFERENCE: f64 = 0.01;
    let is_other =
        alert.revisions > 0 && (alert.loss - alert.loss_at_first).abs() >= LEAST_DIFFERENCE;
    is_other.then_some(alert.loss_at_first)
}

fn write_classes(summary: &ClassSummary, text: &mut String) -> fmt::Result {
    let ClassSummary {
        leading,
        classes,
        leads,
        calibrations,
    } = summary;
    let mut ranked: Vec<_> = classes.iter().collect();
    ranked.sort_by(|a, b| b.plausibility.total_cmp(&a.plausibility));
    let plausibilities = ranked
        .iter()
        .map(|class| format!("{} {}", class.class, plausibility(class.plausibility)));
    writeln!(
        text,
        "  class {leading} leads; plausibilities: {}",
        listed(plausibilities, "less plausible")
    )?;
    // The latest first, because they are the most relevant.
    let leads = leads
        .iter()
        .rev()
        .map(|lead| format!("{} from {:.2} s", lead.class, lead.time_s));
    writeln!(
        text,
        "  leads that lasted, the latest first: {}",
        listed(leads, "before")
    )?;
    if calibrations.is_empty() {
        return Ok(());
    }
    let calibrations = calibrations.iter().rev().map(|by| {
        format!(
            "{} by {:+.1} % at {:.2} s",
            by.class,
            100.0 * by.change,
            by.time_s
        )
    });
    writeln!(
        text,
        "  calibrations, the latest first: {}",
        listed(calibrations, "before")
    )
}

/// Lists the first items and the number of further ones.
fn listed(things: impl ExactSizeIterator<Item = impl Display>, others: &str) -> String {
    let more = things.len().saturating_sub(LISTED);
    let mut text = String::new();
    for (index, thing) in things.take(LISTED).enumerate() {
        // Writing to a string cannot fail.
        let _ = write!(text, "{}{thing}", if index == 0 { "" } else { ", " });
    }
    if more > 0 {
        let _ = write!(text, ", and {more} {others}");
    }
    text
}

/// Formats a plausibility. Values near 0 and 1 do not read as impossible or certain.
fn plausibility(value: f64) -> String {
    match value {
        small if small < 0.001 => "below 0.001".to_owned(),
        large if large > 0.999 => "above 0.999".to_owned(),
        other => format!("{other:.3}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use spandrel_bus::AlertState;

    #[test]
    fn first_loss_is_reported_if_the_sentence_states_another_loss() {
        let alert = |revisions, loss| AlertSummary {
            parameter: "storey-2".to_owned(),
            state: AlertState::Raised,
            time_s: 68.0,
            loss_at_first: 0.12,
            revisions,
            loss,
            credibility: 0.999,
            why: String::new(),
        };
        assert_eq!(loss_at_first(&alert(3, 0.15)), Some(0.12));
        assert_eq!(loss_at_first(&alert(0, 0.12)), None);
        assert_eq!(loss_at_first(&alert(1, 0.125)), None);
    }
}
