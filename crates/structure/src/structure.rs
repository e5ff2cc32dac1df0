//! The structure: all contents of a valid structure file.

use crate::alert_rule::AlertRule;
use crate::classes::ClassesPlan;
use crate::computed::Computed;
use crate::condition::Condition;
use crate::coordinates::Coordinates;
use crate::earthquake_plan::EarthquakePlan;
use crate::error::{Diagnostic, StructureError};
use crate::estimated_response::EstimatedResponse;
use crate::excitation::{Action, Excitation};
use crate::file::StructureFile;
use crate::filter_plan::{Annealing, FilterPlan};
use crate::fusion_plan::FusionPlan;
use crate::judge_plan::JudgePlan;
use crate::linear_form::LinearForm;
use crate::linear_system::LinearSystem;
use crate::modal_plan::ModalPlan;
use crate::modes::Modes;
use crate::node::{Channel, Node};
use crate::noise_level::{NoiseLevel, NoiseSource};
use crate::parameter::Parameter;
use crate::record_map::RecordMap;
use crate::ritz_basis::RitzBasis;
use crate::settings::{BandLimit, IngestSettings, ParticleKeys};
use crate::simulation_plan::SimulationPlan;
use crate::text_encoding::{WrongEncoding, decode};
use nalgebra::{DMatrix, DVector};
use spandrel_filter::InputHold;
use std::fs::File;
use std::io::Read;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

/// Share of the sensor noise below which the start-up aid counts as faded.
const ANNEALING_FADED: f64 = 0.01;

/// A monitored structure: model, parameters, excitation, sensors, and settings of filter and
/// alerts.
///
/// A structure always comes from a structure file and is valid: names are unique and known,
/// matrices are definite, and numbers are in range. Later code does not check them again.
/// [`Structure::read`] and [`Structure::parse`] report all mistakes of a file at once.
///
/// Optional parts, such as the `[judge]`, `[modal]` and `[earthquakes]` tables, are `None` if the
/// file lacks them. All quantities of the model are in SI units. Conditions remain in the unit of
/// the file.
#[derive(Debug, Clone)]
pub struct Structure {
    pub(crate) text: String,
    pub(crate) name: String,
    pub(crate) description: String,
    pub(crate) place: String,
    pub(crate) contact: String,
    pub(crate) runbook: Option<String>,
    pub(crate) coordinates: Option<Coordinates>,
    pub(crate) sampling_rate_hz: f64,
    pub(crate) display_rate_hz: f64,
    pub(crate) system: LinearSystem,
    /// `true` if the file states that the damping is known.
    pub(crate) damping_is_known: bool,
    pub(crate) parameters: Vec<Parameter>,
    pub(crate) excitations: Vec<Excitation>,
    pub(crate) excitation_channels: Vec<Option<usize>>,
    pub(crate) nodes: Vec<Node>,
    pub(crate) observation_channels: Vec<usize>,
    pub(crate) noise_levels: Vec<NoiseLevel>,
    pub(crate) responses: Vec<EstimatedResponse>,
    pub(crate) plan: FilterPlan,
    pub(crate) classes: Option<ClassesPlan>,
    pub(crate) fusion: Option<FusionPlan>,
    pub(crate) band_limit: Option<BandLimit>,
    pub(crate) ingest: IngestSettings,
    pub(crate) alert_rules: Vec<AlertRule>,
    pub(crate) judge: Option<JudgePlan>,
    pub(crate) modal: Option<ModalPlan>,
    pub(crate) earthquakes: Option<EarthquakePlan>,
    pub(crate) record: RecordMap,
    pub(crate) simulation: SimulationPlan,
    pub(crate) conditions: Vec<Condition>,
    /// Errors of the parameters by unmeasured excitations.
    pub(crate) excitation_errors: Computed<Vec<f64>>,
    /// Shapes for the analysis; `None` if the model is analysed as it is.
    pub(crate) analysis_basis: Computed<Option<RitzBasis>>,
    /// Modes as designed. No clone of a structure changes its mass or stiffness.
    pub(crate) modes: Arc<Modes>,
}

/// Maximum size of a structure file (bytes). A thousand storeys with a parameter and a node each
/// take about a third of it. The list of mistakes can take a hundred times the size of the file.
const MAX_BYTES: u64 = 1 << 20;

impl Structure {
    /// Reads a structure file and the matrices that it names.
    ///
    /// # Errors
    /// Returns an error if the file cannot be read, or an error with all its mistakes.
    pub fn read(path: &Path) -> Result<Self, StructureError> {
        Self::parse(&read_text(path)?, path)
    }

    /// Reads a structure file as [`Structure::read`] does, which must have a model.
    ///
    /// # Errors
    /// Returns the same errors as [`Structure::read`]. Also returns an error if the kind of the
    /// model is `modal`.
    pub fn read_with_model(path: &Path) -> Result<Self, StructureError> {
        StructureFile::parse(&read_text(path)?, path)?.resolve_with_model(path)
    }

    /// Parses the text of a structure file.
    ///
    /// Messages contain `path`. Matrix files are relative to it.
    ///
    /// # Errors
    /// Returns an error with all mistakes in the file.
    pub fn parse(text: &str, path: &Path) -> Result<Self, StructureError> {
        StructureFile::parse(text, path)?.resolve(path)
    }

    /// Returns the name, which is one chunk of a key expression.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the description from the file.
    #[must_use]
    pub fn description(&self) -> &str {
        &self.description
    }

    /// Returns the location of the structure, in words. Empty if the file does not state it.
    #[must_use]
    pub fn location(&self) -> &str {
        &self.place
    }

    /// Returns the contact for alarms. Empty if the file does not state one.
    #[must_use]
    pub fn contact(&self) -> &str {
        &self.contact
    }

    /// Returns the address of the instructions for an alarm, from the file. It begins with
    /// `https://` or `http://`.
    #[must_use]
    pub fn runbook(&self) -> Option<&str> {
        self.runbook.as_deref()
    }

    /// Returns the coordinates from the file, if it states them.
    #[must_use]
    pub fn coordinates(&self) -> Option<Coordinates> {
        self.coordinates
    }

    /// Returns `true` if there is a model to identify. Without one, only natural frequencies are
    /// followed.
    #[must_use]
    pub fn has_model(&self) -> bool {
        !self.system.is_empty()
    }

    /// Returns `true` if a filter estimates the parameters from every frame. Otherwise there is no
    /// model, or natural frequencies update it.
    #[must_use]
    pub fn is_filtered(&self) -> bool {
        let is_updated = self
            .modal
            .as_ref()
            .is_some_and(|plan| plan.update.is_some());
        self.has_model() && !is_updated
    }

    /// Returns the names of the degrees of freedom, in the order of the state. Empty without a
    /// model.
    #[must_use]
    pub fn degrees_of_freedom(&self) -> &[String] {
        &self.system.degrees_of_freedom
    }

    /// Returns the text of the file.
    #[must_use]
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Returns a text that changes whenever the basis of the identification changes.
    ///
    /// It is the file without its comments, alert rules, conditions, earthquakes, followed modes,
    /// simulation, record table, description, place, contact, runbook and coordinates, and without
    /// what nodes publish for display, followed by the matrices that it names.
    #[must_use]
    pub fn identification_basis(&self) -> String {
        // The text has been parsed successfully before.
        let mut table: toml::Table = self.text.parse().unwrap_or_default();
        for of_others in [
            "alert",
            "condition",
            "earthquakes",
            "modal",
            "place",
            "simulation",
            "record",
        ] {
            table.remove(of_others);
        }
        if let Some(structure) = table
            .get_mut("structure")
            .and_then(toml::Value::as_table_mut)
        {
            structure.remove("description");
            structure.remove("place");
            structure.remove("contact");
            structure.remove("runbook");
        }
        let fusion = table.get_mut("fusion").and_then(toml::Value::as_table_mut);
        if fusion.is_some_and(|fusion| fusion.remove("waveforms").is_some() && fusion.is_empty()) {
            table.remove("fusion"); // as without the table, which is optional
        }
        let kind = table
            .get("model")
            .and_then(|model| model.get("kind"))
            .and_then(toml::Value::as_str);
        let matrices = if kind == Some("matrices") {
            format!("{:?}", self.system)
        } else {
            String::new()
        };
        format!("{table}{matrices}")
    }

    /// Returns the sampling rate of the frames (Hz).
    #[must_use]
    pub fn sampling_rate_hz(&self) -> f64 {
        self.sampling_rate_hz
    }

    /// Returns the half-life of the filter's memory (s).
    #[must_use]
    pub fn half_life_s(&self) -> f64 {
        self.plan.half_life_s
    }

    /// Returns `Δt` (s), the time between two frames.
    #[must_use]
    pub fn step_s(&self) -> f64 {
        1.0 / self.sampling_rate_hz
    }

    /// Returns the rate of displayed data (Hz).
    #[must_use]
    pub fn display_rate_hz(&self) -> f64 {
        self.display_rate_hz
    }

    /// Returns the sensor nodes in file order.
    #[must_use]
    pub fn nodes(&self) -> &[Node] {
        &self.nodes
    }

    /// Returns all channels in frame order: by node, then by channel, as in the file.
    pub fn channels(&self) -> impl Iterator<Item = &Channel> {
        self.nodes.iter().flat_map(|node| node.channels())
    }

    /// Returns the number of frames per sample of each frame channel: 1 unless its node is slower.
    #[must_use]
    pub fn frames_per_sample(&self) -> Vec<u64> {
        let every = |node: &Node| {
            node.sampling_rate_hz()
                .map_or(1.0, |rate_hz| self.sampling_rate_hz / rate_hz)
        };
        let of_node = |node: &Node| vec![every(node).round() as u64; node.channels().len()];
        self.nodes.iter().flat_map(of_node).collect()
    }

    /// Returns the number of channels of a frame.
    #[must_use]
    pub fn channel_count(&self) -> usize {
        self.nodes.iter().map(|node| node.channels().len()).sum()
    }

    /// Returns the identified parameters in state order.
    #[must_use]
    pub fn parameters(&self) -> &[Parameter] {
        &self.parameters
    }

    /// Returns the excitations; a force field has several components.
    #[must_use]
    pub fn excitations(&self) -> &[Excitation] {
        &self.excitations
    }

    /// Returns the frame channel of each excitation component (N_f); `None` for unmeasured
    /// components.
    #[must_use]
    pub fn excitation_channels(&self) -> &[Option<usize>] {
        &self.excitation_channels
    }

    /// Returns the hold of each excitation component (N_f) between frames.
    ///
    /// Unmeasured components are white noise and constant over a step.
    pub(crate) fn input_holds(&self) -> Vec<InputHold> {
        let hold =
            |channel: &Option<usize>| channel.map_or(InputHold::Zero, |_| self.plan.input_hold);
        self.excitation_channels.iter().map(hold).collect()
    }

    /// Returns the known mean of each excitation component (N_f, m/s² or N), which is 0 except for
    /// force fields.
    #[must_use]
    pub fn mean_excitation(&self) -> DVector<f64> {
        let means = self
            .excitations
            .iter()
            .flat_map(|excitation| match &excitation.action {
                Action::Ground { .. } | Action::Force { .. } => vec![0.0],
                Action::ForceField(field) => field.mean.clone(),
            });
        DVector::from_iterator(self.excitation_channels.len(), means)
    }

    /// Returns the equilibrium state `[x, ẋ]` (2 N_d) under the mean excitation.
    ///
    /// `theta` contains the parameters (ratios to nominal).
    pub(crate) fn static_state(&self, theta: &[f64]) -> DVector<f64> {
        let mean = self.mean_excitation();
        if mean.iter().all(|component| *component == 0.0) {
            return DVector::zeros(2 * self.system.len());
        }
        LinearForm::new(&mut self.model(), theta).rest(&mean)
    }

    /// Returns the expected standard deviation of a noise level (from 0).
    ///
    /// This is the actual standard deviation in the simulation, or else the stated one.
    pub(crate) fn expected_level_std(&self, level: usize) -> f64 {
        let actual = self
            .simulation
            .levels
            .iter()
            .find(|(simulated, _)| *simulated == level);
        actual.map_or(self.noise_levels[level].std, |(_, std)| *std)
    }

    /// Returns the range of components (from 0) of one excitation.
    pub(crate) fn components(&self, excitation: usize) -> Range<usize> {
        let first = self.excitations[..excitation]
            .iter()
            .map(Excitation::component_len)
            .sum();
        first..first + self.excitations[excitation].component_len()
    }

    /// Returns the factor of the variance of an excitation in `Σ_f` (N_f × N_f).
    ///
    /// The factor is 1, or the covariance of a force field.
    pub(crate) fn excitation_pattern(&self, excitation: usize) -> DMatrix<f64> {
        let inputs = self.excitation_channels.len();
        let mut pattern = DMatrix::zeros(inputs, inputs);
        let components = self.components(excitation);
        let mut own = pattern.view_mut(
            (components.start, components.start),
            (components.len(), components.len()),
        );
        match &self.excitations[excitation].action {
            Action::Ground { .. } | Action::Force { .. } => own.fill(1.0),
            Action::ForceField(field) => own.copy_from(&field.covariance),
        }
        pattern
    }

    /// Returns the frame channel of each observation row.
    #[must_use]
    pub fn observation_channels(&self) -> &[usize] {
        &self.observation_channels
    }

    /// Returns the noise levels: one per excitation, then one per group of sensors.
    #[must_use]
    pub fn noise_levels(&self) -> &[NoiseLevel] {
        &self.noise_levels
    }

    /// Returns the unit of the stated standard deviation of a noise level.
    #[must_use]
    pub fn noise_unit(&self, level: &NoiseLevel) -> &'static str {
        match level.source() {
            NoiseSource::Excitation(index) => {
                self.excitations.get(*index).map_or("", Excitation::unit)
            }
            NoiseSource::Sensors(rows) => {
                let channel = rows.first().and_then(|row| self.observations().nth(*row));
                channel.map_or("", |channel| channel.quantity().unit())
            }
        }
    }

    /// Returns the time (s) for which the filter increases sensor noise after its start, to within
    /// 1 %.
    #[must_use]
    pub fn annealing_end_s(&self) -> f64 {
        let Annealing { amount, time_s } = self.plan.annealing;
        time_s * (amount / ANNEALING_FADED).ln().max(0.0)
    }

    /// Returns the responses to estimate.
    #[must_use]
    pub fn estimated_responses(&self) -> &[EstimatedResponse] {
        &self.responses
    }

    /// Returns the alert rules.
    #[must_use]
    pub fn alert_rules(&self) -> &[AlertRule] {
        &self.alert_rules
    }

    /// Returns the low-pass filter of all channels, if any.
    #[must_use]
    pub fn band_limit(&self) -> Option<BandLimit> {
        self.band_limit
    }

    /// Returns the settings of the particle filter; `None` for the Kalman filter.
    #[must_use]
    pub fn particles(&self) -> Option<ParticleKeys> {
        self.plan.particles
    }

    /// Returns `true` if outliers are screened.
    #[must_use]
    pub fn screens_outliers(&self) -> bool {
        self.plan.outliers.is_some()
    }

    /// Returns the settings for the alignment of samples to frames.
    #[must_use]
    pub fn ingest(&self) -> IngestSettings {
        self.ingest
    }

    /// Returns the mapping from the columns of a recording to channels.
    #[must_use]
    pub fn record(&self) -> &RecordMap {
        &self.record
    }

    /// Returns the events of the simulation.
    #[must_use]
    pub fn simulation(&self) -> &SimulationPlan {
        &self.simulation
    }

    /// Returns the conditions that instruments measure beside the motion.
    #[must_use]
    pub fn conditions(&self) -> &[Condition] {
        &self.conditions
    }

    /// Returns what is judged for lasting change. `None` without a table `[judge]`.
    #[must_use]
    pub fn judge(&self) -> Option<&JudgePlan> {
        self.judge.as_ref()
    }

    /// Returns what counts as an earthquake. `None` without a table `[earthquakes]`.
    #[must_use]
    pub fn earthquakes(&self) -> Option<&EarthquakePlan> {
        self.earthquakes.as_ref()
    }

    /// Returns how natural frequencies are followed. `None` without a table `[modal]`.
    #[must_use]
    pub fn modal(&self) -> Option<&ModalPlan> {
        self.modal.as_ref()
    }

    /// Returns the channel of each observation row.
    pub(crate) fn observations(&self) -> impl Iterator<Item = &Channel> {
        self.channels()
            .filter(|channel| !channel.quantity().is_excitation())
    }

    /// Returns the lowest natural frequency as designed (Hz) that is above 0. `None` without one.
    #[must_use]
    pub fn fundamental_hz(&self) -> Option<f64> {
        let frequencies = self.natural_frequencies_hz().into_iter();
        frequencies
            .filter(|frequency| *frequency > 0.0)
            .reduce(f64::min)
    }

    /// Returns the natural frequencies as designed (Hz), lowest first.
    #[must_use]
    pub fn natural_frequencies_hz(&self) -> Vec<f64> {
        let omegas = self.modes.angular_frequencies.iter();
        omegas
            .map(|omega| omega / (2.0 * std::f64::consts::PI))
            .collect()
    }
}

/// Reads the text of a structure file.
pub(crate) fn read_text(path: &Path) -> Result<String, StructureError> {
    let unreadable = |source| StructureError::Unreadable {
        path: path.to_owned(),
        source,
    };
    // Opening a pipe waits for its writer, and a device has no end.
    if !std::fs::metadata(path).map_err(unreadable)?.is_file() {
        return Err(StructureError::NotAFile {
            path: path.to_owned(),
        });
    }
    let mut bytes = Vec::new();
    File::open(path)
        .map_err(unreadable)?
        .take(MAX_BYTES + 1)
        .read_to_end(&mut bytes)
        .map_err(unreadable)?;
    if bytes.len() as u64 > MAX_BYTES {
        return Err(StructureError::TooLarge {
            path: path.to_owned(),
            most: MAX_BYTES,
        });
    }
    let text = decode(bytes).map_err(|wrong| {
        let WrongEncoding { line, found, .. } = wrong;
        let allowed = WrongEncoding::ALLOWED;
        StructureError::Invalid {
            diagnostics: vec![Diagnostic::new(path, line, "encoding", found, allowed)],
        }
    })?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Opening a pipe waits for its writer, so that the program waited forever.
    #[cfg(unix)]
    #[test]
    fn pipe_and_device_are_refused_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe.toml");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status();
        assert!(made.unwrap().success());
        for path in [pipe.as_path(), Path::new("/dev/zero"), folder.path()] {
            let told = Structure::read(path).unwrap_err().to_string();
            let expected = format!(
                "{}: is a folder, a pipe, a device or a socket, must be a regular file",
                path.display()
            );
            assert_eq!(told, expected);
        }
    }

    #[test]
    fn file_in_utf_16_is_named_with_its_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tower.toml");
        std::fs::write(&path, b"\xff\xfe[\0s\0").unwrap();
        let told = Structure::read(&path).unwrap_err().to_string();
        assert!(
            told.ends_with("tower.toml:1: encoding: is UTF-16 (little-endian), must be UTF-8"),
            "{told}"
        );
    }
}
