//! The display topics of an identification: one per parameter, noise level and screened channel.

use crate::identification::{Identification, Output};
use spandrel_bus::{
    Bus, BusError, DisplayPublisher, FitDisplay, Keys, Message, ModelClassDisplay, Name,
    NoiseDisplay, OutlierDisplay, ParameterDisplay, SensorHealthDisplay,
};
use spandrel_service::EventPublisher;
use std::collections::BTreeMap;
use tracing::warn;

/// The topics of one structure.
#[derive(Debug)]
pub(crate) struct Displays {
    parameters: BTreeMap<Name, DisplayPublisher<ParameterDisplay>>,
    noise: BTreeMap<Name, DisplayPublisher<NoiseDisplay>>,
    outliers: BTreeMap<Name, DisplayPublisher<OutlierDisplay>>,
    sensor_health: BTreeMap<Name, DisplayPublisher<SensorHealthDisplay>>,
    classes: Option<DisplayPublisher<ModelClassDisplay>>,
    fit: DisplayPublisher<FitDisplay>,
    events: EventPublisher,
}

impl Displays {
    /// Declares the topics for the estimates of `core`.
    pub(crate) async fn declare(
        core: &Identification,
        bus: &Bus,
        keys: &Keys,
    ) -> Result<Self, BusError> {
        let mut parameters = BTreeMap::new();
        for name in core.parameter_names() {
            parameters.insert(
                name.clone(),
                bus.publish_display(keys.parameter(name)).await?,
            );
        }
        let mut noise = BTreeMap::new();
        for name in core.displayed_noise_names() {
            noise.insert(name.clone(), bus.publish_display(keys.noise(name)).await?);
        }
        let mut outliers = BTreeMap::new();
        for name in core.screened_channels() {
            outliers.insert(name.clone(), bus.publish_display(keys.outlier(name)).await?);
        }
        let mut sensor_health = BTreeMap::new();
        for node in core.compared_nodes() {
            let key = keys.sensor_health(node);
            sensor_health.insert(node.clone(), bus.publish_display(key).await?);
        }
        let classes = match core.compares_classes() {
            true => Some(bus.publish_display(keys.model_class()).await?),
            false => None,
        };
        let fit = bus.publish_display(keys.fit()).await?;
        let events = EventPublisher::declare(bus, keys).await?;
        Ok(Self {
            parameters,
            noise,
            outliers,
            sensor_health,
            classes,
            fit,
            events,
        })
    }

    /// Returns the number of displayed parameters and noise levels.
    pub(crate) fn counts(&self) -> (usize, usize) {
        (self.parameters.len(), self.noise.len())
    }

    /// Publishes a display output. Ignores other outputs.
    pub(crate) async fn put(&self, output: &Output) -> Result<(), BusError> {
        match output {
            Output::Parameter(display) => {
                show(self.parameters.get(&display.parameter), display).await
            }
            Output::Noise(display) => show(self.noise.get(&display.name), display).await,
            Output::Outliers(display) => show(self.outliers.get(&display.channel), display).await,
            Output::SensorHealth(display) => {
                show(self.sensor_health.get(&display.node), display).await
            }
            Output::Classes(display) => show(self.classes.as_ref(), display).await,
            Output::Fit(display) => show(Some(&self.fit), display).await,
            Output::Event(event) => self.events.put(event).await,
            Output::Estimates(_) => Ok(()), // for programs
            Output::Responses(_) => Ok(()), // for files
        }
    }
}

/// Publishes a display message. A message that cannot be encoded is logged and dropped.
async fn show<M: Message>(
    publisher: Option<&DisplayPublisher<M>>,
    message: &M,
) -> Result<(), BusError> {
    let Some(publisher) = publisher else {
        return Ok(());
    };
    match publisher.put(message).await {
        Err(error @ BusError::Encode { .. }) => {
            warn!(%error, "not shown");
            Ok(())
        }
        result => result,
    }
}
