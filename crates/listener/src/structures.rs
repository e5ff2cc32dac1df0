//! The present state of several structures.

use crate::input::{Input, Instance};
use crate::structure::{AlertChange, StructureState};
use spandrel_bus::Name;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

/// Maximum number of structures. Messages of further structures are counted and dropped.
const MOST_STRUCTURES: usize = 256;

/// The present state of all structures from which a message or a token has arrived.
#[derive(Clone, Debug, Default)]
pub struct Structures {
    now: Duration,
    structures: BTreeMap<Name, StructureState>,
    left_out: u64,
}

impl Structures {
    /// Processes one input and appends the resulting changes of alerts to `changes`.
    pub fn handle(&mut self, input: Input, changes: &mut Vec<AlertChange>) {
        match input {
            Input::Now(now) => {
                self.now = now;
                for structure in self.structures.values_mut() {
                    structure.handle(Input::Now(now), changes);
                }
            }
            Input::Present(present) => self.take_present(present, changes),
            // An event does not create a structure.
            Input::Event(_) => {}
            input => match input.structure().cloned() {
                Some(name) => {
                    if let Some(structure) = self.structure_mut(name) {
                        structure.handle(input, changes);
                    }
                }
                None => self.left_out += 1,
            },
        }
    }

    fn take_present(&mut self, present: BTreeSet<Instance>, changes: &mut Vec<AlertChange>) {
        let mut of_each: BTreeMap<Name, BTreeSet<Instance>> = BTreeMap::new();
        for name in self.structures.keys() {
            of_each.insert(name.clone(), BTreeSet::new()); // all of its instances may have left
        }
        for instance in present {
            let of_structure = of_each.entry(instance.structure.clone());
            of_structure.or_default().insert(instance);
        }
        for (name, present) in of_each {
            if let Some(structure) = self.structure_mut(name) {
                structure.handle(Input::Present(present), changes);
            }
        }
        let left_out = &mut self.left_out;
        self.structures.retain(|_, structure| {
            let is_silent = structure.is_silent();
            if is_silent {
                *left_out += structure.left_out;
            }
            !is_silent
        });
    }

    /// Returns the structure, which is created if there is room. Counts dropped messages.
    fn structure_mut(&mut self, name: Name) -> Option<&mut StructureState> {
        if self.structures.len() >= MOST_STRUCTURES && !self.structures.contains_key(&name) {
            self.left_out += 1;
            return None;
        }
        let structure = self.structures.entry(name).or_default();
        structure.handle(Input::Now(self.now), &mut Vec::new());
        Some(structure)
    }

    /// Returns the known structures, in the order of their names.
    pub fn structures(&self) -> impl ExactSizeIterator<Item = (&Name, &StructureState)> {
        self.structures.iter()
    }

    /// Returns one structure, or `None` if its name is unknown.
    #[must_use]
    pub fn structure(&self, name: &Name) -> Option<&StructureState> {
        self.structures.get(name)
    }

    /// Returns the time of the last [`Input::Now`].
    #[must_use]
    pub fn now(&self) -> Duration {
        self.now
    }

    /// Returns the number of messages that were dropped, because a map was full or the key of the
    /// message was wrong.
    #[must_use]
    pub fn left_out(&self) -> u64 {
        let of_each = self.structures.values();
        self.left_out + of_each.map(|structure| structure.left_out).sum::<u64>()
    }
}

#[cfg(test)]
mod tests;
