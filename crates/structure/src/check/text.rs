//! A check as a page for people.

use super::{CheckReport, IdentificationReport, Severity};
use std::fmt;

/// Modes beyond these are left out of the page; all are in the report.
const MODES_SHOWN: usize = 10;

impl fmt::Display for CheckReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "structure {}", self.structure)?;
        writeln!(f, "\n  mode   frequency Hz     period s    damping %")?;
        for (number, mode) in self.modes.iter().enumerate().take(MODES_SHOWN) {
            let (frequency, period, ratio) = (mode.frequency_hz, mode.period_s, 100.0 * mode.damping_ratio);
            writeln!(f, "  {:4} {frequency:14.4} {period:12.4} {ratio:12.3}", number + 1)?;
        }
        if let Some(more) = self.modes.len().checked_sub(MODES_SHOWN).filter(|more| *more > 0) {
            writeln!(f, "  and {more} more, up to {:.2} Hz", self.time_step.highest_frequency_hz)?;
        }
        let step = &self.time_step;
        writeln!(
            f,
            "\n  time step: highest rate times step {:.3}, {} substep(s), {} terms each",
            step.rate_times_step, step.substeps, step.series_order
        )?;
        if let Some(identification) = &self.identification {
            identification.fmt(f)?;
        }
        writeln!(f)?;
        for finding in &self.findings {
            let label = match finding.severity() {
                Severity::Warning => "warning",
                Severity::Note => "note",
            };
            writeln!(f, "  {label}: {finding}")?;
        }
        if self.findings.is_empty() {
            writeln!(f, "  nothing to warn of")?;
        }
        Ok(())
    }
}

impl fmt::Display for IdentificationReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "\n  standard deviations of the parameters (ratios to nominal); the memory of the filter is {:.1} s\n",
            self.memory_s
        )?;
        let after = format!("after {:.0} s", self.duration_s);
        writeln!(
            f,
            "  {:24} {:>9} {after:>13} {:>13} {:>13} {:>11}",
            "parameter", "prior", "long run", "reported", "settles s"
        )?;
        for p in &self.parameters {
            writeln!(
                f,
                "  {:24} {:9.3} {:13.5} {:13.5} {:13.5} {:11.1}",
                p.name, p.prior_std, p.std_after, p.std_steady, p.std_reported, p.settling_s
            )?;
        }
        writeln!(f, "\n  {:24} {:>9} {after:>13}", "noise level", "adapted")?;
        for level in &self.noise_levels {
            let adapted = if level.adapted { "yes" } else { "no" };
            writeln!(f, "  {:24} {adapted:>9} {:11.1} %", level.name, 100.0 * level.relative_std_after)?;
        }
        Ok(())
    }
}
