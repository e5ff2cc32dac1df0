//! Settings of distributed identification, converted to the settings of nodes and station.

use crate::excitation::Action;
use crate::model::StructureModel;
use crate::node::Quantity;
use crate::parameter::Scales;
use crate::structure::Structure;
use nalgebra::{DMatrix, DVector};
use spandrel_filter::fusion::compression::MISSED_MASS;
use spandrel_filter::fusion::{
    CompressedMotion, CovarianceScheme, FeedbackRule, FusionRule, Gaussian, GlobalDetector,
    LocalFilter, MeanLimits, ModalBasis, MotionExchange, NodeSettings, Responses, SampleExchange,
    Station, StationSettings, Weights,
};
use spandrel_filter::{ExtendedKalmanFilter, FilterError, FilterSettings};

/// Range of sound means of stiffness parameters; `HEALTHY_OTHERS` is the range of all others.
///
/// A node or the station restarts if a mean leaves the range. Huang & Yuen (2023), chapter 7,
/// leaves the range open. Without a restart, a diverged node never recovers.
const HEALTHY_STIFFNESS: (f64, f64) = (0.3, 2.5);
const HEALTHY_OTHERS: (f64, f64) = (-0.9, 10.0);

/// Motion data that nodes exchange.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum MotionPlan {
    None,
    /// This number of modes, or `None` for as many as carry the mass.
    Modes(Option<usize>),
    Responses,
    /// Samples at this number of instants in a fusion period.
    Samples(usize),
}

/// The `[fusion]` table of a structure file whose identification is distributed.
#[derive(Debug, Clone, PartialEq)]
pub struct FusionPlan {
    pub(crate) rate_hz: f64,
    pub(crate) rule: FusionRule,
    pub(crate) feedback: FeedbackRule,
    pub(crate) covariance: CovarianceScheme,
    pub(crate) motion: MotionPlan,
    pub(crate) detector: Option<GlobalDetector>,
    pub(crate) stale_periods: f64,
    pub(crate) waveforms: bool,
}

/// The modes in which nodes send their motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SentModes {
    /// Number of modes.
    pub count: usize,
    /// Share of the excited mass that they omit, in the worst excitation direction.
    pub missed_mass: f64,
}

/// Numbers that a node exchanges with the station in a fusion period.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PeriodNumbers {
    /// Numbers that the node sends.
    pub sent: usize,
    /// Numbers that it receives.
    pub received: usize,
}

impl FusionPlan {
    /// Returns the rate of fusions (Hz).
    #[must_use]
    pub fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    /// Returns the rule by which nodes use the fused density.
    #[must_use]
    pub fn feedback(&self) -> FeedbackRule {
        self.feedback
    }

    /// Returns `true` if nodes send covariances as variances only.
    #[must_use]
    pub fn sends_variances(&self) -> bool {
        self.covariance == CovarianceScheme::Identity
    }

    /// Returns `true` if every node receives the motion data or samples of each other node.
    #[must_use]
    pub fn passes_motion_on(&self) -> bool {
        matches!(self.motion, MotionPlan::Responses | MotionPlan::Samples(_))
    }

    /// Returns the test of the nodes, if any.
    #[must_use]
    pub fn detector(&self) -> Option<GlobalDetector> {
        self.detector
    }

    /// Returns the age (fusion periods) above which a message is dropped.
    #[must_use]
    pub fn stale_periods(&self) -> f64 {
        self.stale_periods
    }

    /// Returns `true` if nodes publish waveforms and spectra of their samples for display.
    #[must_use]
    pub fn publishes_waveforms(&self) -> bool {
        self.waveforms
    }
}

impl Structure {
    /// Returns the settings of fusion; `None` if one filter has the samples of all nodes.
    #[must_use]
    pub fn fusion(&self) -> Option<&FusionPlan> {
        self.fusion.as_ref()
    }

    /// Creates the filter of a sensor node, given by its position in the file.
    ///
    /// Returns `None` if identification is not distributed or the node does not exist.
    ///
    /// # Errors
    /// Returns an error if the filter rejects its settings.
    pub fn local_filter(
        &self,
        position: usize,
    ) -> Option<Result<LocalFilter<StructureModel>, FilterError>> {
        self.local_filter_with(position, |_settings| {})
    }

    /// Creates the filter as [`Structure::local_filter`] does, after `change` modified its
    /// settings.
    ///
    /// The settings cover the node's own channels, or the channels of all nodes if nodes exchange
    /// samples.
    ///
    /// # Errors
    /// Returns an error if the filter rejects its settings.
    pub fn local_filter_with(
        &self,
        position: usize,
        change: impl FnOnce(&mut FilterSettings),
    ) -> Option<Result<LocalFilter<StructureModel>, FilterError>> {
        let plan = self.fusion.as_ref()?;
        let own = match plan.motion {
            MotionPlan::Samples(_) => self.with_samples_of_others(position)?,
            MotionPlan::None | MotionPlan::Modes(_) | MotionPlan::Responses => {
                self.of_node(self.nodes.get(position)?.name())?
            }
        };
        let make = || {
            let mut settings = own.filter_settings()?;
            // The station replaces the parameters, so their corrections are not scores.
            settings.misfit = None;
            change(&mut settings);
            let filter = ExtendedKalmanFilter::new(own.model(), settings)?;
            let settings = NodeSettings {
                steps_per_period: (own.sampling_rate_hz() / plan.rate_hz).round() as u64,
                feedback: plan.feedback,
                scheme: plan.covariance,
                motion: self.motion_exchange()?,
                position,
                healthy: self.healthy_limits(),
            };
            LocalFilter::new(filter, settings)
        };
        Some(make())
    }

    /// Creates the central station; `None` if identification is not distributed.
    ///
    /// # Errors
    /// Returns an error if the station rejects its settings.
    pub fn station(&self) -> Option<Result<Station, FilterError>> {
        let plan = self.fusion.as_ref()?;
        let make = || {
            let settings = self.filter_settings()?;
            let (first, len) = (
                settings.prior_mean.len() - self.parameters.len(),
                self.parameters.len(),
            );
            let prior_std = settings.prior_std.rows(first, len);
            // The prior of a filter applies to its first sample.
            let covariance =
                DMatrix::from_diagonal(&prior_std.map(|std| std * std / settings.fading.value()));
            Station::new(StationSettings {
                nodes: self.nodes.len(),
                prior: Gaussian {
                    mean: settings.prior_mean.rows(first, len).into_owned(),
                    covariance,
                },
                growth_per_period: settings
                    .fading
                    .value()
                    .powf(self.sampling_rate_hz / plan.rate_hz),
                variance_bound: settings.variance_bound.rows(first, len).into_owned(),
                rule: plan.rule,
                feedback: plan.feedback,
                motion: self.motion_exchange()?,
                same_instant: 0.5 * plan.rate_hz / self.sampling_rate_hz,
                detector: plan.detector,
                stale_periods: plan.stale_periods,
                healthy: self.healthy_limits(),
            })
        };
        Some(make())
    }

    /// Returns the minimum and maximum mean of each parameter that a working filter can have.
    fn healthy_limits(&self) -> MeanLimits {
        let limits = |of: fn((f64, f64)) -> f64| {
            let limit = |parameter: &crate::Parameter| match parameter.scales {
                Scales::Stiffness(_) => of(HEALTHY_STIFFNESS),
                _ => of(HEALTHY_OTHERS),
            };
            DVector::from_iterator(self.parameters.len(), self.parameters.iter().map(limit))
        };
        MeanLimits {
            lower: limits(|(low, _)| low),
            upper: limits(|(_, high)| high),
        }
    }

    /// Returns the modes that nodes send; `None` if they send no modes.
    #[must_use]
    pub fn sent_modes(&self) -> Option<SentModes> {
        let MotionPlan::Modes(asked) = self.fusion.as_ref()?.motion else {
            return None;
        };
        let (basis, missed) = self.modal_basis(asked)?;
        Some(SentModes {
            count: basis.modes(),
            missed_mass: missed,
        })
    }

    /// Returns how many numbers a node sends and receives in a fusion period; `None` if
    /// identification is not distributed.
    #[must_use]
    pub fn numbers_per_period(&self, position: usize) -> Option<PeriodNumbers> {
        let plan = self.fusion.as_ref()?;
        let parameters = self.parameters.len();
        let weights = match plan.covariance {
            CovarianceScheme::Full => Weights::Mixed,
            CovarianceScheme::Identity => Weights::Vector,
        };
        let with_modes = |modes| weights.message_numbers(self.system.len(), modes, parameters);
        let density = with_modes(0);
        Some(match self.motion_exchange().ok()? {
            MotionExchange::None => PeriodNumbers {
                sent: density,
                received: density,
            },
            MotionExchange::Modes(basis) => PeriodNumbers {
                sent: with_modes(basis.modes()),
                received: with_modes(basis.modes()),
            },
            MotionExchange::Responses(nodes) => {
                let all: usize = nodes.iter().map(|node| 2 * node.rows().nrows()).sum();
                PeriodNumbers {
                    sent: density + 2 * nodes.get(position)?.rows().nrows(),
                    received: density + all,
                }
            }
            MotionExchange::Samples(exchange) => {
                let all: usize = (0..exchange.nodes())
                    .map(|node| exchange.numbers(node))
                    .sum();
                PeriodNumbers {
                    sent: density + exchange.numbers(position),
                    received: density + all - exchange.numbers(position),
                }
            }
        })
    }

    /// Returns the unit exponents of a node's exchanged samples, one per observation.
    ///
    /// A unit is a power of two of the SI unit. The result is empty if nodes exchange no samples.
    #[must_use]
    pub fn told_units(&self, position: usize) -> Vec<i16> {
        match self.motion_exchange() {
            Ok(MotionExchange::Samples(exchange)) => exchange.unit_exponents(position).to_vec(),
            Ok(_) | Err(_) => Vec::new(),
        }
    }

    /// Returns displacements and velocities (2 N_d; m, rad, m/s, rad/s) of a motion fused in modes.
    ///
    /// Returns `None` if nodes exchange no modes.
    #[must_use]
    pub fn extract_motion(&self, motion: &CompressedMotion) -> Option<DVector<f64>> {
        match self.motion_exchange().ok()? {
            MotionExchange::Modes(basis) if motion.mean.len() == 2 * basis.modes() => {
                Some(basis.extract(&motion.mean))
            }
            _ => None,
        }
    }

    fn motion_exchange(&self) -> Result<MotionExchange, FilterError> {
        let Some(plan) = &self.fusion else {
            return Ok(MotionExchange::None);
        };
        Ok(match plan.motion {
            MotionPlan::None => MotionExchange::None,
            MotionPlan::Modes(asked) => match self.modal_basis(asked) {
                Some((basis, _)) => MotionExchange::Modes(basis),
                None => MotionExchange::None,
            },
            MotionPlan::Responses => MotionExchange::Responses(
                self.nodes.iter().map(|node| self.responses(node)).collect(),
            ),
            MotionPlan::Samples(instants) => {
                let exchange = SampleExchange::new(&self.observations_by_node(), instants);
                MotionExchange::Samples(exchange.rounded_to(self.sample_units()))
            }
        })
    }

    /// Selects the modes with the largest effective mass: as many as requested, or until they carry
    /// 95 % of the mass.
    ///
    /// The condition holds in every direction, Huang & Yuen (2023), chapter 6. The first modes by
    /// frequency can omit the most important one. Also returns the omitted share of the mass.
    fn modal_basis(&self, asked: Option<usize>) -> Option<(ModalBasis, f64)> {
        let shapes = &self.modes.shapes;
        let mass = self.system.mass.to_dense();
        let all = ModalBasis::new(shapes.clone(), &mass).ok()?;
        let shares: Vec<Vec<f64>> = self
            .excitations
            .iter()
            .filter_map(|excitation| match &excitation.action {
                Action::Ground { influence } => Some(DVector::from_column_slice(influence)),
                Action::Force { .. } | Action::ForceField(_) => None,
            })
            .map(|influence| all.effective_mass_shares(&influence, &mass))
            .collect();
        let missed = |kept: &[usize]| {
            let of_direction =
                |shares: &Vec<f64>| 1.0 - kept.iter().map(|mode| shares[*mode]).sum::<f64>();
            shares.iter().map(of_direction).fold(0.0, f64::max)
        };
        // Rounded to millionths, so that modes without mass stay in the order of frequency.
        let carried = |mode: usize| {
            shares
                .iter()
                .map(|shares| (shares[mode] * 1e6).round())
                .fold(0.0, f64::max)
        };
        let mut order: Vec<usize> = (0..shapes.ncols()).collect();
        order.sort_by(|one, other| carried(*other).total_cmp(&carried(*one)));
        let count = match asked {
            Some(count) => count.min(order.len()),
            None => (1..=order.len()).find(|count| missed(&order[..*count]) <= MISSED_MASS)?,
        };
        order.truncate(count);
        order.sort_unstable();
        let basis = ModalBasis::new(shapes.select_columns(&order), &mass).ok()?;
        Some((basis, missed(&order)))
    }

    /// Returns the displacements, velocities and strains that a node measures, with the rates of
    /// displacements and strains.
    fn responses(&self, node: &crate::Node) -> Responses {
        let free = self.system.len();
        let mut rows: Vec<DVector<f64>> = Vec::new();
        for channel in node.channels() {
            let row = |shift: usize| {
                let mut row = DVector::zeros(2 * free);
                for (dof, coefficient) in &channel.sensed {
                    row[shift + dof] = *coefficient;
                }
                row
            };
            match channel.quantity() {
                Quantity::Displacement | Quantity::Strain => rows.extend([row(0), row(free)]),
                Quantity::Velocity => rows.push(row(free)),
                other => debug_assert!(!other.is_told_as_response()),
            }
        }
        Responses::new(DMatrix::from_fn(rows.len(), 2 * free, |row, column| {
            rows[row][column]
        }))
    }
}
