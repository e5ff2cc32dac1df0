//! The outlier reports of a node: events at once, and the state of each channel with every message
//! to the station.

use crate::error::{IdentifyError, key_name};
use crate::screening::ScreeningView;
use serde::{Deserialize, Serialize};
use spandrel_bus::{EventKind, MaskedSpan, Name, ScreenedChannel};
use spandrel_filter::{ChannelScreen, OutlierChange};

/// One channel of a node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct NodeScreening {
    view: ScreeningView,
    /// Last reported state. Feedback resets the filter to its last message, so the same change can
    /// occur again.
    faulty: bool,
    masked: Option<MaskedSpan>,
}

impl NodeScreening {
    /// Creates the view of a channel in training.
    ///
    /// # Errors
    /// Returns an error if the name cannot be part of a key expression.
    pub(crate) fn new(structure: &str, channel: &str) -> Result<Self, IdentifyError> {
        Ok(Self {
            view: ScreeningView::new(key_name(structure, channel)?),
            faulty: false,
            masked: None,
        })
    }

    /// Returns the name of the channel.
    pub(crate) fn channel(&self) -> &Name {
        self.view.channel()
    }

    /// Processes the result of a sample. Returns kind, description and reason of an event, if any.
    pub(crate) fn take(
        &mut self,
        time_ns: i64,
        screen: &ChannelScreen,
    ) -> Option<(EventKind, &'static str, String)> {
        let change = self.view.take(time_ns, screen);
        if self.faulty != screen.faulty() {
            self.faulty = screen.faulty();
            let why = change.map(|(_, why)| why);
            return Some(match self.faulty {
                true => (
                    EventKind::ChannelExcluded,
                    "the sensor or the model is wrong: its samples are not used",
                    why.unwrap_or_else(|| {
                        "its samples are far from the predicted response of the structure"
                            .to_owned()
                    }),
                ),
                false => (
                    EventKind::ChannelBack,
                    "the sensor is used again",
                    why.unwrap_or_else(|| "its screening restarted with the filter".to_owned()),
                ),
            });
        }
        match change {
            Some((OutlierChange::Rescaled, why)) => Some((
                EventKind::Calibration,
                "the scale of its residuals was re-estimated",
                why,
            )),
            Some(_) | None => None,
        }
    }

    /// Returns the state of the channel for a message to the station.
    pub(crate) fn report(&mut self, screen: &ChannelScreen) -> ScreenedChannel {
        let masked = self.view.masked();
        let is_new = masked != self.masked;
        self.masked = masked;
        ScreenedChannel {
            state: crate::screening::state(screen),
            rejected: screen.rejected(),
            screened: screen.seen(),
            recent_share: screen.rejected_share() as f32,
            scale: screen.scale() as f32,
            masked: masked.filter(|_| is_new),
        }
    }
}
