//! The display of the outliers of one channel.

use serde::{Deserialize, Serialize};
use spandrel_bus::{ChannelState, MaskedSpan, Name, OutlierDisplay};
use spandrel_filter::{ChannelScreen, OutlierChange, Verdict};

/// The displayed state of one channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ScreeningView {
    channel: Name,
    /// Number of samples rejected at the last message.
    told: u64,
    masked: Option<MaskedSpan>,
    /// Whether the last sample was rejected.
    masking: bool,
}

impl ScreeningView {
    pub(crate) fn new(channel: Name) -> Self {
        Self {
            channel,
            told: 0,
            masked: None,
            masking: false,
        }
    }

    pub(crate) fn channel(&self) -> &Name {
        &self.channel
    }

    /// Returns the latest interval in which every sample was rejected.
    pub(crate) fn masked(&self) -> Option<MaskedSpan> {
        self.masked
    }

    /// Processes the result of one sample. Returns a change with the reason for its event, if any.
    pub(crate) fn take(
        &mut self,
        time_ns: i64,
        screen: &ChannelScreen,
    ) -> Option<(OutlierChange, String)> {
        match screen.verdict() {
            Verdict::Outlier | Verdict::Faulty => {
                let (from_ns, samples) = match self.masked {
                    Some(span) if self.masking => (span.from_ns, span.samples + 1),
                    Some(_) | None => (time_ns, 1),
                };
                self.masked = Some(MaskedSpan {
                    from_ns,
                    to_ns: time_ns,
                    samples,
                });
                self.masking = true;
            }
            Verdict::Regular => self.masking = false,
            Verdict::Missing => {}
        }
        let share = 100.0 * screen.rejected_share();
        match screen.change()? {
            change @ OutlierChange::FaultBegan => Some((
                change,
                format!(
                    "{share:.0} % of its recent samples are far from the predicted response \
                    of the structure"
                ),
            )),
            change @ OutlierChange::FaultEnded => Some((
                change,
                "its samples agree with the structure again".to_owned(),
            )),
            change @ OutlierChange::Rescaled => Some((
                change,
                format!(
                    "too many samples were rejected; the scale of the residuals is now {:.2e}",
                    screen.scale()
                ),
            )),
            OutlierChange::Trained => None,
        }
    }

    /// Returns the display message of one time, and restarts the count of rejected samples.
    pub(crate) fn display(
        &mut self,
        structure: &Name,
        time_ns: i64,
        screen: &ChannelScreen,
    ) -> OutlierDisplay {
        // A restarted filter counts from zero.
        let flagged = screen
            .rejected()
            .checked_sub(self.told)
            .unwrap_or(screen.rejected());
        self.told = screen.rejected();
        OutlierDisplay {
            structure: structure.clone(),
            channel: self.channel.clone(),
            time_ns,
            state: state(screen),
            flagged,
            rejected: screen.rejected(),
            screened: screen.seen(),
            recent_share: screen.rejected_share(),
            scale: screen.scale(),
            masked: self.masked,
        }
    }
}

/// Returns the state of the screening of a channel.
pub(crate) fn state(screen: &ChannelScreen) -> ChannelState {
    match (screen.faulty(), screen.trained()) {
        (true, _) => ChannelState::Faulty,
        (false, true) => ChannelState::Screening,
        (false, false) => ChannelState::Training,
    }
}
