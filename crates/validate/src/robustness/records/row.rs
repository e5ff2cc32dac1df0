//! One line of the table.

use serde::{Deserialize, Serialize};

/// Result of one condition over several runs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Description of the condition.
    pub condition: String,
    /// Number of runs, 0 if the records are missing.
    pub runs: usize,
    /// Number of runs with a false alarm, or `None` if the row does not concern alerts.
    pub false_alerts: Option<usize>,
    /// Share of the comparisons within the stated interval, 0 to 1.
    pub coverage: Option<f64>,
    /// Shares (0 to 1) of the frames in motion with the verdicts supported, doubtful and
    /// contradicted. A frame is in motion while a measured response exceeds the threshold of its
    /// case, and shortly afterwards.
    pub verdicts: Option<[f64; 3]>,
    /// Share of the frames in motion with a decision on every parameter, 0 to 1.
    pub decided_share: Option<f64>,
    /// Shares of the frames in motion without a decision, 0 to 1, each with the reason and the
    /// first parameter without a decision.
    #[serde(default)]
    pub undecided: Vec<(String, f64)>,
    /// Requirement in words.
    pub required: String,
    /// Whether the requirement holds, or `None` without a requirement or without records.
    pub passed: Option<bool>,
    /// Result in words.
    pub seen: String,
}

impl Row {
    /// Creates a row of a condition.
    pub(super) fn new(condition: impl Into<String>, required: impl Into<String>) -> Self {
        Self {
            condition: condition.into(),
            runs: 0,
            false_alerts: None,
            coverage: None,
            verdicts: None,
            decided_share: None,
            undecided: Vec::new(),
            required: required.into(),
            passed: None,
            seen: String::new(),
        }
    }

    /// Creates a skipped row with the reason.
    pub(super) fn skipped(
        condition: impl Into<String>,
        required: impl Into<String>,
        why: impl Into<String>,
    ) -> Self {
        Self {
            seen: format!("skipped: {}", why.into()),
            ..Self::new(condition, required)
        }
    }
}

impl std::fmt::Display for Row {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let percent = |share: Option<f64>| {
            share.map_or("-".to_owned(), |share| format!("{:.0} %", 100.0 * share))
        };
        let result = match self.passed {
            Some(true) => "as required",
            Some(false) => "MISSED",
            None => "not judged",
        };
        writeln!(f, "{} ({} runs): {result}", self.condition, self.runs)?;
        writeln!(f, "    required: {}", self.required)?;
        if let Some(alerts) = self.false_alerts {
            writeln!(f, "    runs with a false alert: {alerts}")?;
        }
        if let Some(verdicts) = self.verdicts {
            let [supported, doubtful, contradicted] = verdicts.map(|share| 100.0 * share);
            writeln!(
                f,
                "    fit supported {supported:.0} %, doubtful {doubtful:.0} %, contradicted \
                 {contradicted:.0} %"
            )?;
        }
        writeln!(
            f,
            "    inside the stated interval: {}; time with a decision: {}",
            percent(self.coverage),
            percent(self.decided_share)
        )?;
        if !self.undecided.is_empty() {
            let shares: Vec<String> = self
                .undecided
                .iter()
                .map(|(why, share)| format!("{why} {:.0} %", 100.0 * share))
                .collect();
            writeln!(f, "    without a decision: {}", shares.join(", "))?;
        }
        write!(f, "    {}", self.seen.trim_end().replace("; ", "\n    "))
    }
}
