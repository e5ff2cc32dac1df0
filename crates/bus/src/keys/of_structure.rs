//! The key expressions of one structure.

use super::{KeyFamily, Service, expression_of};
use crate::name::{Name, NameError};

/// Key expressions of one structure.
///
/// ```
/// use spandrel_bus::{Keys, Name};
/// let keys = Keys::new("spandrel".parse()?, "tower".parse()?);
/// assert_eq!(keys.samples(&"roof".parse()?), "spandrel/tower/sensor/roof/samples");
/// # Ok::<(), spandrel_bus::NameError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Keys {
    root: Name,
    structure: Name,
}

impl Keys {
    /// Creates the key expressions below `{root}/{structure}`.
    #[must_use]
    pub fn new(root: Name, structure: Name) -> Self {
        Self { root, structure }
    }

    /// Creates the key expressions from unchecked texts.
    ///
    /// # Errors
    /// Returns [`NameError`] if one of the texts is not a [`Name`].
    pub fn parse(root: &str, structure: &str) -> Result<Self, NameError> {
        Ok(Self::new(Name::new(root)?, Name::new(structure)?))
    }

    /// Returns the root.
    #[must_use]
    pub fn root(&self) -> &Name {
        &self.root
    }

    /// Returns the name of the structure.
    #[must_use]
    pub fn structure(&self) -> &Name {
        &self.structure
    }

    /// Returns the key of one item of a family.
    pub(super) fn key(&self, family: KeyFamily, of: &Name) -> String {
        family.expression(&self.root, Some(&self.structure), Some(of))
    }

    /// Returns the key expression of a family, which is its key if the family has a single key.
    fn all(&self, family: KeyFamily) -> String {
        family.expression(&self.root, Some(&self.structure), None)
    }

    /// Returns the key of the sample blocks of one node.
    #[must_use]
    pub fn samples(&self, node: &Name) -> String {
        self.key(KeyFamily::Samples, node)
    }

    /// Returns the key to query the latest sample blocks of one node. The node replies.
    #[must_use]
    pub fn buffer(&self, node: &Name) -> String {
        self.key(KeyFamily::Buffer, node)
    }

    /// Returns the key of the frame blocks.
    #[must_use]
    pub fn frames(&self) -> String {
        self.all(KeyFamily::Frames)
    }

    /// Returns the key to query frame blocks. Ingest replies.
    #[must_use]
    pub fn recording(&self) -> String {
        self.all(KeyFamily::Recording)
    }

    /// Returns the key of the estimate blocks.
    #[must_use]
    pub fn estimates(&self) -> String {
        self.all(KeyFamily::Estimates)
    }

    /// Returns the key to query the latest estimate blocks. Identify replies.
    #[must_use]
    pub fn estimates_buffer(&self) -> String {
        self.all(KeyFamily::EstimatesBuffer)
    }

    /// Returns the key of one parameter at display rate.
    #[must_use]
    pub fn parameter(&self, parameter: &Name) -> String {
        self.key(KeyFamily::Parameter, parameter)
    }

    /// Returns the key expression of all parameters at display rate.
    #[must_use]
    pub fn all_parameters(&self) -> String {
        self.all(KeyFamily::Parameter)
    }

    /// Returns the key of the loss of one parameter at display rate.
    #[must_use]
    pub fn loss(&self, parameter: &Name) -> String {
        self.key(KeyFamily::Loss, parameter)
    }

    /// Returns the key expression of the losses of all parameters at display rate.
    #[must_use]
    pub fn all_losses(&self) -> String {
        self.all(KeyFamily::Loss)
    }

    /// Returns the key of one noise parameter at display rate.
    #[must_use]
    pub fn noise(&self, name: &Name) -> String {
        self.key(KeyFamily::Noise, name)
    }

    /// Returns the key expression of all noise parameters at display rate.
    #[must_use]
    pub fn all_noise(&self) -> String {
        self.all(KeyFamily::Noise)
    }

    /// Returns the key of the plausibility of the model classes.
    #[must_use]
    pub fn model_class(&self) -> String {
        self.all(KeyFamily::ModelClass)
    }

    /// Returns the key of the state of the monitoring.
    #[must_use]
    pub fn monitoring(&self) -> String {
        self.all(KeyFamily::Monitoring)
    }

    /// Returns the key of the verdict on the fit.
    #[must_use]
    pub fn fit(&self) -> String {
        self.all(KeyFamily::Fit)
    }

    /// Returns the key of the compressed local estimate of one node.
    #[must_use]
    pub fn local(&self, node: &Name) -> String {
        self.key(KeyFamily::Local, node)
    }

    /// Returns the key of the station's feedback to one node.
    #[must_use]
    pub fn feedback(&self, node: &Name) -> String {
        self.key(KeyFamily::Feedback, node)
    }

    /// Returns the key expression of the compressed local estimates of all nodes.
    #[must_use]
    pub fn all_local(&self) -> String {
        self.all(KeyFamily::Local)
    }

    /// Returns the key of the station's assessment of one node.
    #[must_use]
    pub fn node(&self, node: &Name) -> String {
        self.key(KeyFamily::Node, node)
    }

    /// Returns the key expression of the station's assessments of all nodes.
    #[must_use]
    pub fn all_nodes(&self) -> String {
        self.all(KeyFamily::Node)
    }

    /// Returns the key of the outliers of one channel.
    #[must_use]
    pub fn outlier(&self, channel: &Name) -> String {
        self.key(KeyFamily::Outlier, channel)
    }

    /// Returns the key expression of the outliers of all channels.
    #[must_use]
    pub fn all_outliers(&self) -> String {
        self.all(KeyFamily::Outlier)
    }

    /// Returns the key of the comparison of one node's sensors with the others.
    #[must_use]
    pub fn sensor_health(&self, node: &Name) -> String {
        self.key(KeyFamily::SensorHealth, node)
    }

    /// Returns the key expression of the comparisons of all nodes' sensors.
    #[must_use]
    pub fn all_sensor_health(&self) -> String {
        self.all(KeyFamily::SensorHealth)
    }

    /// Returns the key of the reduced samples of one node.
    #[must_use]
    pub fn waveform(&self, node: &Name) -> String {
        self.key(KeyFamily::Waveform, node)
    }

    /// Returns the key of the spectra of one node.
    #[must_use]
    pub fn spectrum(&self, node: &Name) -> String {
        self.key(KeyFamily::Spectrum, node)
    }

    /// Returns the key of one condition.
    #[must_use]
    pub fn condition(&self, name: &Name) -> String {
        self.key(KeyFamily::Condition, name)
    }

    /// Returns the key expression of all conditions.
    #[must_use]
    pub fn all_conditions(&self) -> String {
        self.all(KeyFamily::Condition)
    }

    /// Returns the key of the epochs of one judged quantity.
    #[must_use]
    pub fn epoch(&self, quantity: &Name) -> String {
        self.key(KeyFamily::Epoch, quantity)
    }

    /// Returns the key expression of the epochs of all judged quantities.
    #[must_use]
    pub fn all_epochs(&self) -> String {
        self.all(KeyFamily::Epoch)
    }

    /// Returns the key of the judgement of one quantity.
    #[must_use]
    pub fn judgement(&self, quantity: &Name) -> String {
        self.key(KeyFamily::Judgement, quantity)
    }

    /// Returns the key expression of the judgements of all quantities.
    #[must_use]
    pub fn all_judgements(&self) -> String {
        self.all(KeyFamily::Judgement)
    }

    /// Returns the key to query the history of the judgement of one quantity. The service `judge`
    /// replies.
    #[must_use]
    pub fn judgement_course(&self, quantity: &Name) -> String {
        self.key(KeyFamily::JudgementCourse, quantity)
    }

    /// Returns the key expression of the judgement histories of all quantities.
    #[must_use]
    pub fn all_judgement_courses(&self) -> String {
        self.all(KeyFamily::JudgementCourse)
    }

    /// Returns the key to query one report of an earthquake, or the list `index`. The service
    /// reports replies.
    #[must_use]
    pub fn report(&self, report: &Name) -> String {
        self.key(KeyFamily::Report, report)
    }

    /// Returns the key expression of all reports.
    #[must_use]
    pub fn all_reports(&self) -> String {
        self.all(KeyFamily::Report)
    }

    /// Returns the key of one declared mode.
    #[must_use]
    pub fn mode(&self, mode: &Name) -> String {
        self.key(KeyFamily::Mode, mode)
    }

    /// Returns the key expression of all declared modes.
    #[must_use]
    pub fn all_modes(&self) -> String {
        self.all(KeyFamily::Mode)
    }

    /// Returns the key of the events, such as restarts, calibrations and exclusions.
    #[must_use]
    pub fn event(&self) -> String {
        self.all(KeyFamily::Event)
    }

    /// Returns the key of the alert of one parameter.
    #[must_use]
    pub fn alert(&self, parameter: &Name) -> String {
        self.key(KeyFamily::Alert, parameter)
    }

    /// Returns the key expression of the alerts of all parameters, without their acknowledgements.
    #[must_use]
    pub fn all_alerts(&self) -> String {
        self.all(KeyFamily::Alert)
    }

    /// Returns the key to query the latest alert changes. The alert service replies.
    #[must_use]
    pub fn alert_log(&self) -> String {
        self.all(KeyFamily::AlertLog)
    }

    /// Returns the key to query the latest changes of lasting losses. The service `judge` replies.
    #[must_use]
    pub fn judgement_log(&self) -> String {
        self.all(KeyFamily::JudgementLog)
    }

    /// Returns the key to acknowledge the alert of one parameter.
    #[must_use]
    pub fn acknowledge(&self, parameter: &Name) -> String {
        self.key(KeyFamily::Acknowledge, parameter)
    }

    /// Returns the key expression of the acknowledgements of all alerts.
    #[must_use]
    pub fn all_acknowledgements(&self) -> String {
        self.all(KeyFamily::Acknowledge)
    }

    /// Returns the key on which people begin and end maintenance.
    #[must_use]
    pub fn maintenance(&self) -> String {
        self.all(KeyFamily::Maintenance)
    }

    /// Returns the key on which people annotate the structure.
    #[must_use]
    pub fn annotation(&self) -> String {
        self.all(KeyFamily::Annotation)
    }

    /// Returns the key of the liveliness token that marks the samples of one node as simulated.
    #[must_use]
    pub fn simulated(&self, node: &Name) -> String {
        self.key(KeyFamily::Simulated, node)
    }

    /// Returns the key expression of the tokens of all simulated nodes.
    #[must_use]
    pub fn all_simulated(&self) -> String {
        self.all(KeyFamily::Simulated)
    }

    /// Returns the key of the progress of one service.
    #[must_use]
    pub fn progress(&self, service: Service) -> String {
        self.all(KeyFamily::Progress(service))
    }

    /// Returns the key of the status of one instance of a service.
    #[must_use]
    pub fn status(&self, service: Service, id: &Name) -> String {
        self.key(KeyFamily::Status(service), id)
    }

    /// Returns the key expression of the statuses of all instances of one service.
    #[must_use]
    pub fn statuses(&self, service: Service) -> String {
        self.all(KeyFamily::Status(service))
    }

    /// Returns the key expression of the statuses of all instances of all services.
    #[must_use]
    pub fn all_statuses(&self) -> String {
        expression_of(&self.root, Some(&self.structure), "status/*/*")
    }

    /// Returns the key of the liveliness token of one instance of a service. For a sensor, `id` is
    /// the node.
    #[must_use]
    pub fn live(&self, service: Service, id: &Name) -> String {
        self.key(KeyFamily::Live(service), id)
    }

    /// Returns the key expression of the liveliness tokens of all instances of a service.
    #[must_use]
    pub fn all_live(&self, service: Service) -> String {
        self.all(KeyFamily::Live(service))
    }

    /// Returns the key of the liveliness token that claims the lead of the identification. `claim`
    /// is the name of the claim.
    #[must_use]
    pub fn leader(&self, claim: &Name) -> String {
        self.key(KeyFamily::Leader, claim)
    }

    /// Returns the key expression of all claims to lead the identification.
    #[must_use]
    pub fn all_leaders(&self) -> String {
        self.all(KeyFamily::Leader)
    }

    /// Returns the key to query the state of the leading identification.
    #[must_use]
    pub fn state(&self) -> String {
        self.all(KeyFamily::State)
    }

    /// Returns the key to query the structure file.
    #[must_use]
    pub fn description(&self) -> String {
        self.all(KeyFamily::Description)
    }

    /// Returns the key to query the history of one parameter. The query parameter `kind` selects
    /// another quantity of this name.
    #[must_use]
    pub fn history(&self, parameter: &Name) -> String {
        self.key(KeyFamily::History, parameter)
    }

    /// Returns the key expression of all histories.
    #[must_use]
    pub fn all_history(&self) -> String {
        self.all(KeyFamily::History)
    }

    /// Returns the key to query the log of alerts, acknowledgements and events.
    #[must_use]
    pub fn history_log(&self) -> String {
        self.all(KeyFamily::HistoryLog)
    }
}
