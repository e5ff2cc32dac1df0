//! A fifty-storey shear building under ground motion or wind, with its records: Yuen, Liang & Kuok
//! (2013).
//!
//! The published outputs
//! are absolute accelerations. Turbulence has no direct effect on them, but the mean wind does. The
//! published data must have been generated in this way.

use nalgebra::{DMatrix, DVector};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use spandrel_filter::{
    DirectTerm, ExtendedKalmanFilter, FilterError, FilterSettings, Frame, LinearModel, ModalModel,
    NoiseModel, NoiseParameter, NoiseRule, NoiseSettings, NoiseTarget, StateSpace, Step,
};
use std::f64::consts::{PI, TAU};

pub(crate) const FLOORS: usize = 50;
pub(crate) const STEP_S: f64 = 0.01;
/// Mass of every floor (kg).
pub(crate) const FLOOR_MASS: f64 = 4.00e5;
/// Stiffness of every storey (N/m).
pub(crate) const STOREY_STIFFNESS: f64 = 652.9e6;
/// Rayleigh coefficients `α_M` (1/s) and `α_K` (s).
pub(crate) const RAYLEIGH: [f64; 2] = [1.885e-2, 3.980e-3];
/// Floors with an accelerometer, counted from 1.
pub(crate) const SENSED: [usize; 6] = [1, 10, 20, 30, 40, 50];
/// Floors in the published tables, counted from 1.
pub(crate) const TABULATED: [usize; 10] = [5, 10, 15, 20, 25, 30, 35, 40, 45, 50];
/// Intensity `S₀` (m²/s³), two-sided over circular frequency.
pub(crate) const GROUND_INTENSITY: f64 = 1.20e-4;
/// Sensor noise variance of the published realisation (m²/s⁴).
pub(crate) const PRINTED_SENSOR_VARIANCE: f64 = 1.320e-4;
/// Variance of every displacement (m²) and velocity (m²/s²) before the first datum.
pub(crate) const PRIOR_VARIANCE: f64 = 1e-4;
/// Sensor noise relative to the response of the top floor (root mean squares).
const NOISE_SHARE: f64 = 0.05;

/// Returns the variance `2π S₀/Δt` of a white process of two-sided intensity `s_0` that is constant
/// within each step.
pub(crate) fn held_variance(s_0: f64, step_s: f64) -> f64 {
    TAU * s_0 / step_s
}

/// The three published cases.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Case {
    /// Stationary ground motion and noise.
    Ground,
    /// Modulated ground motion and stationary noise.
    ModulatedGround,
    /// Mean wind with modulated, spatially correlated turbulence, and noise with the same
    /// modulation.
    Wind,
}

impl Case {
    /// Returns the modulation `A_f(t)`.
    pub(crate) fn modulation(self, t: f64) -> f64 {
        match self {
            Self::Ground => 1.0,
            Self::ModulatedGround if t < 300.0 => 1.0 + 0.2 * (2.0 * PI * t / 50.0).sin(),
            Self::ModulatedGround if t < 700.0 => {
                1.0 + 4.0 * (t - 300.0) * (-0.02 * (t - 100.0)).exp()
            }
            Self::ModulatedGround => 1.0 - 0.2 * (2.0 * PI * t / 50.0).sin(),
            Self::Wind if t < 500.0 => 1.0 + t / 500.0,
            Self::Wind => 3.0 - t / 500.0,
        }
    }

    /// Returns `θ_f` at the time `t` (s): a variance (m²/s⁴) of the ground motion, or a factor on
    /// [`turbulence`].
    pub(crate) fn excitation_level(self, t: f64) -> f64 {
        let unit = if self == Self::Wind {
            1.0
        } else {
            held_variance(GROUND_INTENSITY, STEP_S)
        };
        unit * self.modulation(t).powi(2)
    }

    /// Returns `A_f²` of the sensor noise.
    pub(crate) fn noise_modulation(self, t: f64) -> f64 {
        if self == Self::Wind {
            self.modulation(t).powi(2)
        } else {
            1.0
        }
    }

    /// Returns the matrix that `θ_f` multiplies (N_f × N_f).
    pub(crate) fn excitation_pattern(self) -> DMatrix<f64> {
        if self == Self::Wind {
            turbulence()
        } else {
            DMatrix::identity(1, 1)
        }
    }

    /// Returns the known part of the excitation (N_f): the mean wind, or zero.
    pub(crate) fn known_excitation(self) -> DVector<f64> {
        if self == Self::Wind {
            mean_wind()
        } else {
            DVector::zeros(1)
        }
    }

    /// Returns the distribution matrix `T` (N_d × N_f).
    pub(crate) fn distribution(self) -> DMatrix<f64> {
        if self == Self::Wind {
            DMatrix::identity(FLOORS, FLOORS)
        } else {
            DMatrix::from_element(FLOORS, 1, -FLOOR_MASS)
        }
    }

    fn direct_term(self) -> DirectTerm {
        if self != Self::Wind {
            return DirectTerm::None;
        }
        let mut direct = DMatrix::zeros(SENSED.len(), FLOORS);
        for (row, floor) in SENSED.into_iter().enumerate() {
            direct[(row, floor - 1)] = 1.0 / FLOOR_MASS;
        }
        DirectTerm::Known(direct)
    }
}

/// Returns `M`, `L` and `K` (N_d × N_d).
pub(crate) fn matrices() -> [DMatrix<f64>; 3] {
    let mass = DMatrix::identity(FLOORS, FLOORS) * FLOOR_MASS;
    let stiffness = DMatrix::from_fn(FLOORS, FLOORS, |i, j| match i.abs_diff(j) {
        0 if i + 1 == FLOORS => STOREY_STIFFNESS,
        0 => 2.0 * STOREY_STIFFNESS,
        1 => -STOREY_STIFFNESS,
        _ => 0.0,
    });
    let damping = &mass * RAYLEIGH[0] + &stiffness * RAYLEIGH[1];
    [mass, damping, stiffness]
}

/// Returns the observation matrix `C_d` (N_0 × 2 N_d) of the absolute accelerations of the sensed
/// floors.
pub(crate) fn observation() -> DMatrix<f64> {
    let [_, damping, stiffness] = matrices();
    let mut observation = DMatrix::zeros(SENSED.len(), 2 * FLOORS);
    for (row, floor) in SENSED.into_iter().enumerate() {
        for j in 0..FLOORS {
            observation[(row, j)] = -stiffness[(floor - 1, j)] / FLOOR_MASS;
            observation[(row, FLOORS + j)] = -damping[(floor - 1, j)] / FLOOR_MASS;
        }
    }
    observation
}

/// Returns the height of floor `i` above ground (m), counted from 0.
fn height(i: usize) -> f64 {
    2.5 * (i + 1) as f64
}

/// Returns the mean wind force on every floor (N).
pub(crate) fn mean_wind() -> DVector<f64> {
    let (density, reference_height, speed, drag, area, exponent) =
        (1.20, 10.0, 10.0_f64, 2.03, 20.0 * 2.5, 0.3);
    DVector::from_fn(FLOORS, |i, _| {
        0.5 * density
            * speed
            * speed
            * drag
            * area
            * (height(i) / reference_height).powf(2.0 * exponent)
    })
}

/// Returns the covariance of the turbulence at unit modulation (N_d × N_d, N²).
pub(crate) fn turbulence() -> DMatrix<f64> {
    let (intensity, reference_height) = (0.2_f64, 10.0);
    let wind = mean_wind();
    DMatrix::from_fn(FLOORS, FLOORS, |i, j| {
        intensity.powi(2)
            * (-(height(i) - height(j)).abs() / reference_height).exp()
            * wind[i]
            * wind[j]
    })
}

/// Returns the building in physical coordinates.
pub(crate) fn physical_model(case: Case) -> Result<StateSpace, FilterError> {
    let [mass, damping, stiffness] = matrices();
    StateSpace::second_order(
        [&mass, &damping, &stiffness],
        &case.distribution(),
        observation(),
        case.direct_term(),
    )
}

/// Returns the building in modal coordinates.
pub(crate) fn modal_model(case: Case) -> Result<ModalModel, FilterError> {
    let [mass, damping, stiffness] = matrices();
    ModalModel::new(
        [&mass, &damping, &stiffness],
        &case.distribution(),
        &observation(),
        case.direct_term(),
    )
}

/// Returns the discrete system for the closed forms, with the two noise levels.
pub(crate) fn discrete_model(
    case: Case,
    excitation_level: f64,
    sensor_variance: f64,
) -> Result<LinearModel, FilterError> {
    let model = physical_model(case)?;
    let (transition, input) = LinearModel::discretise(model.system(), model.input(), STEP_S);
    Ok(LinearModel {
        transition,
        input,
        observation: observation(),
        excitation_covariance: case.excitation_pattern() * excitation_level,
        sensor_covariance: DMatrix::identity(SENSED.len(), SENSED.len()) * sensor_variance,
    })
}

/// Returns the static displacement under the known excitation (N_d), from which every record and
/// every filter starts.
pub(crate) fn static_displacement(case: Case) -> DVector<f64> {
    if case != Case::Wind {
        return DVector::zeros(FLOORS); // no known excitation
    }
    // The building is statically determinate: the shear of each storey is the total wind force
    // above it.
    let wind = mean_wind();
    let mut drift_sum = 0.0;
    DVector::from_fn(FLOORS, |i, _| {
        drift_sum += wind.rows(i, FLOORS - i).sum() / STOREY_STIFFNESS;
        drift_sum
    })
}

/// The 20 quantities of the tables at one time: displacements (m), then velocities (m/s), of
/// [`TABULATED`].
pub(crate) type Tabulated = [f64; 2 * TABULATED.len()];

/// Selects the tabulated quantities from `[x, ẋ]`.
pub(crate) fn tabulated(state: impl Fn(usize) -> f64) -> Tabulated {
    std::array::from_fn(|k| {
        let half = k / TABULATED.len();
        state(half * FLOORS + TABULATED[k % TABULATED.len()] - 1)
    })
}

/// A simulated record. Entry `k` belongs to the time `(k + 1) Δt`.
#[derive(Debug, Clone)]
pub(crate) struct Record {
    pub(crate) case: Case,
    pub(crate) data: Vec<[f64; SENSED.len()]>,
    pub(crate) truth: Vec<Tabulated>,
    /// Variance of the sensor noise at unit modulation (m²/s⁴), from 5 % of the top floor's root
    /// mean square.
    pub(crate) sensor_variance: f64,
}

impl Record {
    /// Returns the actual `[θ_f, θ_n]` for the datum `k`. The force is that of the preceding step.
    pub(crate) fn actual_levels(&self, k: usize) -> [f64; 2] {
        let (force_t, datum_t) = (k as f64 * STEP_S, (k + 1) as f64 * STEP_S);
        [
            self.case.excitation_level(force_t),
            self.sensor_variance * self.case.noise_modulation(datum_t),
        ]
    }
}

/// Simulates `seconds` of a case with the exact transition in physical coordinates.
pub(crate) fn simulate(case: Case, seed: u64, seconds: f64) -> Result<Record, FilterError> {
    let model = physical_model(case)?;
    let (transition, held) = LinearModel::discretise(model.system(), model.input(), STEP_S);
    let (outputs, known) = (observation(), case.known_excitation());
    let direct = match case.direct_term() {
        DirectTerm::Known(matrix) => &matrix * &known,
        DirectTerm::None | DirectTerm::Whole(_) => DVector::zeros(SENSED.len()),
    };
    let pattern_factor = case
        .excitation_pattern()
        .cholesky()
        .map(|factor| factor.unpack());
    let pattern_factor = pattern_factor.ok_or(FilterError::InnovationCovariance { pivot: 0 })?;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut draw = || -> f64 { StandardNormal.sample(&mut rng) };
    let unit = case.excitation_level(0.0).sqrt() / case.modulation(0.0);
    let count = (seconds / STEP_S).round() as usize;
    let mut state = DVector::zeros(2 * FLOORS);
    state
        .rows_mut(0, FLOORS)
        .copy_from(&static_displacement(case));
    let (mut next, mut white, mut force) = (state.clone(), known.clone(), known.clone());
    let (mut data, mut truth) = (Vec::with_capacity(count), Vec::with_capacity(count));
    let mut datum = DVector::zeros(SENSED.len());
    for k in 0..count {
        white.iter_mut().for_each(|entry| *entry = draw());
        force.copy_from(&known);
        force.gemv(
            unit * case.modulation(k as f64 * STEP_S),
            &pattern_factor,
            &white,
            1.0,
        );
        next.gemv(1.0, &transition, &state, 0.0);
        next.gemv(1.0, &held, &force, 1.0);
        std::mem::swap(&mut state, &mut next);
        datum.copy_from(&direct);
        datum.gemv(1.0, &outputs, &state, 1.0);
        data.push(std::array::from_fn(|j| datum[j]));
        truth.push(tabulated(|j| state[j]));
    }
    let top = SENSED.len() - 1;
    let mean_square = data
        .iter()
        .map(|z: &[f64; SENSED.len()]| z[top] * z[top])
        .sum::<f64>()
        / count as f64;
    let sensor_variance = NOISE_SHARE * NOISE_SHARE * mean_square;
    for (k, z) in data.iter_mut().enumerate() {
        let std = (sensor_variance * case.noise_modulation((k + 1) as f64 * STEP_S)).sqrt();
        z.iter_mut().for_each(|value| *value += std * draw());
    }
    Ok(Record {
        case,
        data,
        truth,
        sensor_variance,
    })
}

/// Noise levels `[θ_f, θ_n]` of a filter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Levels {
    /// Actual levels at every time.
    Actual,
    /// Constant levels.
    Constant([f64; 2]),
    /// Start values of the two-stage rule, which identifies the levels.
    Online([f64; 2]),
}

/// Returns the noise model with both levels as parameters. Their deviations are a third of the
/// start values.
pub(crate) fn noise_model(case: Case, [excitation, sensors]: [f64; 2]) -> NoiseModel {
    let inputs = case.distribution().ncols();
    let parameter = |name: &str, target, pattern, start: f64| NoiseParameter {
        name: name.to_owned(),
        target,
        pattern,
        start,
        start_std: start / 3.0,
    };
    let channels = SENSED.len();
    let mut model = NoiseModel::known(
        DMatrix::zeros(inputs, inputs),
        DMatrix::zeros(channels, channels),
    );
    model.parameters = vec![
        parameter(
            "force",
            NoiseTarget::Excitation,
            case.excitation_pattern(),
            excitation,
        ),
        parameter(
            "sensors",
            NoiseTarget::Sensors,
            DMatrix::identity(channels, channels),
            sensors,
        ),
    ];
    model
}

/// Returns the published settings for [`modal_model`], with the half-life of the noise parameters
/// in steps.
///
/// The prior variances of the physical state are converted to modal ones. Floors of equal mass keep
/// them uncorrelated.
pub(crate) fn filter_settings(
    model: &ModalModel,
    case: Case,
    levels: Levels,
    half_life_steps: f64,
) -> FilterSettings {
    let (start, rule) = match levels {
        Levels::Actual => ([1.0, 1.0], NoiseRule::Fixed), // set before every step
        Levels::Constant(levels) => (levels, NoiseRule::Fixed),
        Levels::Online(start) => (start, NoiseRule::HalfOrDouble),
    };
    let mut physical = DVector::zeros(2 * FLOORS);
    physical
        .rows_mut(0, FLOORS)
        .copy_from(&static_displacement(case));
    let mean = model.modal_from_physical() * physical;
    let std = DVector::repeat(2 * FLOORS, (PRIOR_VARIANCE * FLOOR_MASS).sqrt());
    let mut settings = FilterSettings::new(STEP_S, mean, std, noise_model(case, start));
    settings.noise_settings = NoiseSettings {
        rule,
        fading: 2f64.powf(2.0 / half_life_steps),
        training_steps: (TAU / model.angular_frequencies()[0] / STEP_S) as u64,
        ..NoiseSettings::default()
    };
    settings
}

/// A filter and its position in a record of the building.
pub(crate) struct Run<'a> {
    pub(crate) filter: ExtendedKalmanFilter<ModalModel>,
    record: &'a Record,
    levels: Levels,
    known: DVector<f64>,
    /// Rows of `Φ` of the tabulated floors (10 × N_d).
    shapes: DMatrix<f64>,
}

impl<'a> Run<'a> {
    /// Creates a filter at `t = 0`, one step before the first datum.
    pub(crate) fn new(
        record: &'a Record,
        levels: Levels,
        half_life_steps: f64,
    ) -> Result<Self, FilterError> {
        let model = modal_model(record.case)?;
        let settings = filter_settings(&model, record.case, levels, half_life_steps);
        Self::with_settings(model, settings, record, levels)
    }

    /// Creates a filter with other settings.
    pub(crate) fn with_settings(
        model: ModalModel,
        settings: FilterSettings,
        record: &'a Record,
        levels: Levels,
    ) -> Result<Self, FilterError> {
        let shapes = DMatrix::from_fn(TABULATED.len(), FLOORS, |i, j| {
            model.shapes()[(TABULATED[i] - 1, j)]
        });
        let mut filter = ExtendedKalmanFilter::new(model, settings)?;
        let known = record.case.known_excitation();
        // The prior applies to time 0, which has no datum.
        filter.step(Frame {
            observations: &[f64::NAN; SENSED.len()],
            excitation: known.as_slice(),
        })?;
        Ok(Self {
            filter,
            record,
            levels,
            known,
            shapes,
        })
    }

    /// Processes the datum `k`.
    pub(crate) fn step(&mut self, k: usize) -> Result<Step, FilterError> {
        if self.levels == Levels::Actual {
            self.filter
                .set_noise_parameters(&self.record.actual_levels(k))?;
        }
        self.filter.step(Frame {
            observations: &self.record.data[k],
            excitation: self.known.as_slice(),
        })
    }

    /// Returns filtered minus true values of the tabulated quantities after the datum `k`.
    pub(crate) fn errors(&self, k: usize) -> Tabulated {
        let mean = self.filter.mean();
        std::array::from_fn(|i| {
            let (half, floor) = (i / TABULATED.len(), i % TABULATED.len());
            let modal = mean.rows(half * FLOORS, FLOORS);
            self.shapes
                .row(floor)
                .iter()
                .zip(modal.iter())
                .map(|(shape, q)| shape * q)
                .sum::<f64>()
                - self.record.truth[k][i]
        })
    }
}

/// Root mean square and largest absolute value of the errors of the tabulated quantities.
#[derive(Debug, Clone, Default)]
pub(crate) struct ErrorStatistics {
    squares: Tabulated,
    pub(crate) largest: Tabulated,
    count: f64,
}

impl ErrorStatistics {
    pub(crate) fn add(&mut self, errors: &Tabulated) {
        for (k, error) in errors.iter().enumerate() {
            self.squares[k] += error * error;
            self.largest[k] = self.largest[k].max(error.abs());
        }
        self.count += 1.0;
    }

    pub(crate) fn rms(&self) -> Tabulated {
        self.squares.map(|sum| (sum / self.count).sqrt())
    }
}
