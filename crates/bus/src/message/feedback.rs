//! Feedback of the station to a sensor node after a fusion.

use serde::{Deserialize, Serialize};

use super::local::{MotionNumbers, ToldMotion, check_density, check_motion};
use super::{Format, Header, MAX_CHANNELS, Malformed, Message, bounded, check_count};

/// Reply to one message of a node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FeedbackMessage {
    /// Source: the station; epoch: of the station; sequence: number of the fusion; time: of the
    /// fusion.
    pub header: Header,
    /// Epoch of the node's message.
    pub node_epoch: u64,
    /// Sequence number of the node's message.
    pub answers: u64,
    /// Number of fused nodes.
    pub nodes: u16,
    /// Means of the parameters, in the order of the structure file, ratios to nominal.
    pub mean: Vec<f64>,
    /// Covariance of the parameters: upper triangle by columns, p(p+1)/2 values, or only the p
    /// variances.
    pub covariance: Vec<f64>,
    /// Fused motion, if the nodes exchange motion in modes.
    pub motion: Option<MotionNumbers>,
    /// Responses or samples per node, in the order of the structure file, if the nodes exchange
    /// them.
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
