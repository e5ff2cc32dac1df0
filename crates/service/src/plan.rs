//! What services start with.

use std::sync::Arc;

use spandrel_bus::{Bus, BusError, Keys, LiveToken, Name, Service};
use spandrel_checkpoint::Remembering;
use spandrel_structure::Structure;

use crate::{Clock, StatusPublisher};

/// One instance of a service: its session, id and clock.
#[derive(Clone, Debug)]
pub struct ServiceInstance {
    /// The connection to the bus.
    pub bus: Bus,
    /// Id of the instance, as in the keys of its status and its liveliness token.
    pub id: Name,
    /// The wall clock.
    pub clock: Clock,
}

/// A structure that services monitor. A copy is cheap.
#[derive(Clone, Debug)]
pub struct Monitored {
    /// The structure.
    pub structure: Arc<Structure>,
    /// The key expressions of the structure.
    pub keys: Keys,
    /// Where and how often services save their state. `None` if they do not.
    pub remembering: Option<Remembering>,
}

impl ServiceInstance {
    /// Creates an instance with the clock of the machine.
    #[must_use]
    pub fn new(bus: &Bus, id: Name) -> Self {
        Self {
            bus: bus.clone(),
            id,
            clock: Clock::of_machine(),
        }
    }

    /// Declares the status of this instance for a structure.
    ///
    /// # Errors
    /// Returns an error if the bus rejects the declaration.
    pub async fn publish_status(
        &self,
        service: Service,
        keys: &Keys,
    ) -> Result<StatusPublisher, BusError> {
        StatusPublisher::declare(self, service, keys).await
    }

    /// Announces that this instance is present. Call it last, because others then rely on it.
    ///
    /// # Errors
    /// Returns an error if the bus rejects the declaration.
    pub async fn announce(&self, service: Service, keys: &Keys) -> Result<LiveToken, BusError> {
        self.bus.announce(keys.live(service, &self.id)).await
    }
}

impl Monitored {
    /// Describes a structure whose services save no state.
    #[must_use]
    pub fn new(structure: &Structure, keys: Keys) -> Self {
        Self {
            structure: Arc::new(structure.clone()),
            keys,
            remembering: None,
        }
    }
}
