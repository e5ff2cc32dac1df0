//! What the station tells a sensor node of the fusion.

use serde::{Deserialize, Serialize};

use super::local::{MotionNumbers, ToldMotion, check_density, check_motion};
use super::{Format, Header, MAX_CHANNELS, Malformed, Message, bounded, check_count};

/// The answer to one message of a node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FeedbackMessage {
    /// Source: the station; epoch: its own; sequence: number of the fusion; time: that of the fusion.
    pub header: Header,
    /// Epoch of the node whose message this answers.
    pub node_epoch: u64,
    /// The message that this answers, by the node's own count.
    pub answers: u64,
    /// How many nodes were fused.
    pub nodes: u16,
    /// Means of the parameters, in the order of the structure file, ratios to nominal.
    pub mean: Vec<f64>,
    /// Their covariance: upper triangle by columns, p(p+1)/2 values, or the p variances alone.
    pub covariance: Vec<f64>,
    /// The fused motion, where motion is sent in modes.
    pub motion: Option<MotionNumbers>,
    /// By node in the order of the file: its responses or samples, where these are exchanged.
    #[serde(deserialize_with = "bounded::list::<_, _, MAX_CHANNELS>")]
    pub responses: Vec<Option<ToldMotion>>,
}

impl Message for FeedbackMessage {
    const TYPE: &'static str = "feedback";
    const VERSION: u16 = 2;
    const FORMAT: Format = Format::Postcard;

    fn check(&self) -> Result<(), Malformed> {
        check_density(&self.mean, &self.covariance)?;
        if let Some(motion) = &self.motion {
            check_motion(motion)?;
        }
        check_count("responses", self.responses.len(), 0, MAX_CHANNELS)?;
        self.responses
            .iter()
            .flatten()
            .try_for_each(ToldMotion::check)?;
        self.header.check(1)
    }
}
