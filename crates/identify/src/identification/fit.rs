//! The published verdict on the fit. This is the only module that knows the types of the filter and
//! of the bus.

use crate::estimator::Estimator;
use spandrel_bus::{
    ChannelFitDisplay, FitDisplay, FitReason, FitReasons, FitVerdict, Name, NameError,
};
use spandrel_filter::ChannelFit;
use spandrel_structure::Structure;

/// A verdict on the fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Judged {
    pub(super) verdict: FitVerdict,
    pub(super) reasons: FitReasons,
    pub(super) follows_jump: bool,
}

/// Returns the verdict after the last step. `None` if the fit is not measured.
pub(super) fn judged(estimator: &Estimator) -> Option<Judged> {
    let fit = estimator.fit();
    Some(Judged {
        verdict: verdict(fit.verdict()?),
        reasons: fit.reasons().map(reason).collect(),
        follows_jump: fit.follows_jump(),
    })
}

/// The display of the verdict.
#[derive(Debug, Clone)]
pub(super) struct FitView {
    /// Channel of each observation row.
    channels: Vec<Name>,
    displayed: Option<Judged>,
}

impl FitView {
    pub(super) fn new(structure: &Structure) -> Result<Self, NameError> {
        let names: Vec<&str> = structure.channels().map(|channel| channel.name()).collect();
        let channels = structure
            .observation_channels()
            .iter()
            .map(|channel| Name::new(names[*channel]));
        Ok(Self {
            channels: channels.collect::<Result<_, _>>()?,
            displayed: None,
        })
    }

    /// Continues from a checkpoint, whose last verdict has already been displayed.
    pub(super) fn resume(&mut self, estimator: &Estimator) {
        self.displayed = judged(estimator);
    }

    /// Returns the display of the verdict. `None` if the fit is not assessed.
    pub(super) fn display(
        &mut self,
        structure: &Name,
        time_ns: i64,
        estimator: &Estimator,
    ) -> Option<FitDisplay> {
        let judged = judged(estimator)?;
        self.displayed = Some(judged);
        let Judged {
            verdict,
            reasons,
            follows_jump,
        } = judged;
        let channels = self
            .channels
            .iter()
            .zip(estimator.channel_fits())
            .map(|(name, fit)| channel_display(name, fit));
        let channels = channels.collect();
        Some(FitDisplay {
            structure: structure.clone(),
            time_ns,
            verdict,
            reasons,
            follows_jump,
            channels,
        })
    }

    /// Returns the display if the verdict differs from the last displayed one.
    pub(super) fn take_change(
        &mut self,
        structure: &Name,
        time_ns: i64,
        estimator: &Estimator,
    ) -> Option<FitDisplay> {
        if judged(estimator) == self.displayed {
            return None;
        }
        self.display(structure, time_ns, estimator)
    }
}

fn channel_display(name: &Name, fit: &ChannelFit) -> ChannelFitDisplay {
    let known = |measure: f64| measure.is_finite().then_some(measure);
    ChannelFitDisplay {
        channel: name.clone(),
        largest_autocorrelation: known(fit.largest_autocorrelation),
        explained_share: known(fit.explained_share),
        // Rounding can make a correlation slightly larger than one.
        excitation_correlation: known(fit.excitation_correlation)
            .map(|correlation| correlation.clamp(-1.0, 1.0)),
        noise_ratio: known(fit.noise_ratio),
    }
}

fn verdict(verdict: spandrel_filter::FitVerdict) -> FitVerdict {
    use spandrel_filter::FitVerdict as Found;
    match verdict {
        Found::Supported => FitVerdict::Supported,
        Found::Doubtful => FitVerdict::Doubtful,
        Found::Contradicted => FitVerdict::Contradicted,
    }
}

fn reason(reason: spandrel_filter::FitReason) -> FitReason {
    use spandrel_filter::FitReason as Found;
    match reason {
        Found::InnovationBurst => FitReason::InnovationBurst,
        Found::ParameterAtBound => FitReason::ParameterAtBound,
        Found::FarFromPrior => FitReason::FarFromPrior,
        Found::LittleExplained => FitReason::LittleExplained,
        Found::ExcessNoise => FitReason::ExcessNoise,
        Found::CorrelatedInnovations => FitReason::CorrelatedInnovations,
        Found::WanderingParameters => FitReason::WanderingParameters,
        Found::ExcitationInInnovations => FitReason::ExcitationInInnovations,
    }
}
