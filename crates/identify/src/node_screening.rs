//! What a node tells of the outliers of its own channels: events at once, and how they stand with each message to the station.

use crate::error::IdentifyError;
use crate::screening::ScreeningView;
use serde::{Deserialize, Serialize};
use spandrel_bus::{EventKind, MaskedSpan, Name, ScreenedChannel};
use spandrel_filter::{ChannelScreen, OutlierChange};

/// One channel of a node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct NodeScreening {
    view: ScreeningView,
    /// what was told last: an answer of the station takes the filter back to its last message, and what it finds may come again
    faulty: bool,
    masked: Option<MaskedSpan>,
}

impl NodeScreening {
    /// A channel that is in training.
    ///
    /// # Errors
    /// When its name is no chunk of a key.
    pub(crate) fn new(structure: &str, channel: &str) -> Result<Self, IdentifyError> {
        let refused = |source| IdentifyError::Name {
            structure: structure.to_owned(),
            source,
        };
        Ok(Self {
            view: ScreeningView::new(Name::new(channel).map_err(refused)?),
            faulty: false,
            masked: None,
        })
    }

    /// The name of the channel.
    pub(crate) fn channel(&self) -> &Name {
        self.view.channel()
    }

    /// Takes what became of a sample; returns kind, what and why where it is worth an event.
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
                    "the sensor is faulty: its samples are not used",
                    why.unwrap_or_else(|| {
                        "its samples are far from what the structure does".to_owned()
                    }),
                ),
                false => (
                    EventKind::ChannelBack,
                    "the sensor is used again",
                    why.unwrap_or_else(|| "its screening began anew with the filter".to_owned()),
                ),
            });
        }
        match change {
            Some((OutlierChange::Rescaled, why)) => Some((
                EventKind::Calibration,
                "the scale of its residuals was estimated anew",
                why,
            )),
            Some(_) | None => None,
        }
    }

    /// How the channel stands, for a message to the station.
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
