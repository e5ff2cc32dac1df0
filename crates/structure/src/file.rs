//! Reads a structure file from top to bottom and assembles the structure.
//!
//! Each table is checked as far as its references could be read, so that one mistake hides no
//! other. The result is a structure only if the file contains no mistake.

mod alert;
mod chain;
mod classes;
mod condition;
mod damping;
mod earthquakes;
mod excitation;
mod filter;
mod force_field;
mod fusion;
mod judge;
mod matrices;
mod mesh;
mod modal;
mod model;
mod node;
mod outliers;
mod parameter;
mod place;
mod record;
mod response;
mod simulation;
mod tower;

use crate::computed::Computed;
use crate::diagnostics::{Diagnostics, counted, one_of};
use crate::error::StructureError;
use crate::judge_plan::JudgedStructure;
use crate::linear_system::{Damping, LinearSystem};
use crate::modes::Modes;
use crate::noise_level::{NoiseLevel, NoiseSource};
use crate::section::{Allowed, Section, short};
use crate::structure::Structure;
use model::ModelRead;
use node::ChannelRead;
use spandrel_filter::NoiseRule;
use std::ops::RangeInclusive;
use std::path::Path;
use std::sync::Arc;
use toml::Spanned;
use toml::de::DeTable;

/// Text of a structure file, and its tables with the position of every key and value.
pub(crate) struct StructureFile<'t> {
    text: &'t str,
    document: Spanned<DeTable<'t>>,
    /// Stands for a table that may be missing.
    empty: DeTable<'t>,
}

/// The `[structure]` table.
struct Head {
    name: Option<String>,
    description: String,
    place: String,
    contact: String,
    runbook: Option<String>,
    rate_hz: Option<f64>,
    display_rate_hz: f64,
    distributed: Option<Spanned<bool>>,
}

impl Head {
    fn is_distributed(&self) -> bool {
        let distributed = self.distributed.as_ref();
        distributed.is_some_and(|distributed| *distributed.get_ref())
    }

    /// Reports distributed identification, which other tables of the file exclude.
    fn refuse_distributed(&self, diagnostics: &Diagnostics<'_>, allowed: &str) {
        if let Some(distributed) = self.distributed.as_ref().filter(|_| self.is_distributed()) {
            diagnostics.report(
                distributed.span(),
                "structure.identification",
                "is \"distributed\"",
                allowed,
            );
        }
    }
}

/// The `[model]` and `[damping]` tables, as far as they could be read.
struct Dynamics {
    /// The model with its damping, or an empty system for the kind `modal`.
    system: Option<LinearSystem>,
    modes: Option<Modes>,
    damping: Option<Damping>,
    damping_is_known: bool,
    /// Whether the kind is `modal`.
    is_modal: bool,
}

/// Default of `display-rate-hz`: as fast as the eye can follow.
const DISPLAY_RATE_HZ: f64 = 10.0;

impl<'t> StructureFile<'t> {
    /// Parses the TOML and reports every syntax error with its line.
    pub(crate) fn parse(text: &'t str, path: &Path) -> Result<Self, StructureError> {
        let (document, errors) = DeTable::parse_recoverable(text);
        if errors.is_empty() {
            return Ok(Self {
                text,
                document,
                empty: DeTable::new(),
            });
        }
        let diagnostics = Diagnostics::new(path, text);
        if path
            .extension()
            .is_some_and(|extension| extension.eq_ignore_ascii_case("csv"))
        {
            diagnostics.report(
                0..0,
                "syntax",
                "is a recording",
                "must be a structure file (TOML)",
            );
            return Err(StructureError::Invalid {
                diagnostics: diagnostics.into_sorted(),
            });
        }
        for error in errors {
            let found = error.message().trim().replace('\n', ", ");
            diagnostics.report(
                error.span().unwrap_or(0..0),
                "syntax",
                found,
                "must be TOML",
            );
        }
        Err(StructureError::Invalid {
            diagnostics: diagnostics.into_sorted(),
        })
    }

    /// Checks the whole file and assembles the structure.
    pub(crate) fn resolve(&self, path: &Path) -> Result<Structure, StructureError> {
        let diagnostics = Diagnostics::new(path, self.text);
        let structure = self.read(&diagnostics);
        let clean = diagnostics.is_empty();
        match structure {
            Some(structure) if clean => Ok(structure),
            _ => Err(StructureError::Invalid {
                diagnostics: diagnostics.into_sorted(),
            }),
        }
    }

    /// Checks the whole file, and that it has a model.
    pub(crate) fn resolve_with_model(&self, path: &Path) -> Result<Structure, StructureError> {
        let structure = self.resolve(path)?;
        if structure.has_model() {
            return Ok(structure);
        }
        let diagnostics = Diagnostics::new(path, self.text);
        let mut file = Section::new(self.document.get_ref(), "", 0..0, &diagnostics);
        if let Some(model) = file.table("model") {
            let (span, key) = (model.span_of("kind"), model.key("kind"));
            diagnostics.report(span, key, "is \"modal\"", model::WITH_A_MODEL);
        }
        Err(StructureError::Invalid {
            diagnostics: diagnostics.into_sorted(),
        })
    }

    /// Checks the file as far as it is judged: completely if it has a model.
    pub(crate) fn resolve_judged(&self, path: &Path) -> Result<JudgedStructure, StructureError> {
        let diagnostics = Diagnostics::new(path, self.text);
        let judged = self.read_judged(&diagnostics);
        let clean = diagnostics.is_empty();
        match judged {
            Some(judged) if clean => Ok(judged),
            _ => Err(StructureError::Invalid {
                diagnostics: diagnostics.into_sorted(),
            }),
        }
    }

    fn read_judged(&self, diagnostics: &Diagnostics<'_>) -> Option<JudgedStructure> {
        let mut file = Section::new(self.document.get_ref(), "", 0..0, diagnostics);
        if file.contains("model") {
            let structure = self.read(diagnostics);
            let table = file.required_table("judge");
            let structure = structure.filter(|_| table.is_some())?;
            return Some(JudgedStructure {
                name: structure.name,
                plan: structure.judge?,
            });
        }
        let head = file.required_table("structure").and_then(|mut section| {
            let name = section.required_name("name").map(Spanned::into_inner);
            section.text("description");
            section.text("place");
            section.text("contact");
            section.link("runbook");
            section.finish();
            name
        });
        place::read_place(file.table("place"));
        let table = file.required_table("judge");
        let plan = judge::read_judge(table);
        file.finish();
        Some(JudgedStructure {
            name: head?,
            plan: plan?,
        })
    }

    fn read(&self, diagnostics: &Diagnostics<'_>) -> Option<Structure> {
        let mut file = Section::new(self.document.get_ref(), "", 0..0, diagnostics);
        let head = read_head(&mut file);
        let Dynamics {
            system,
            modes,
            damping,
            damping_is_known,
            is_modal,
        } = read_dynamics(&mut file);
        let system = system.as_ref();
        let nodes = node::read_nodes(&mut file, head.rate_hz, system);
        let channels = (!nodes.incomplete).then_some(&nodes.channels[..]);
        let (declared_excitations, excitations) = match is_modal {
            true => (0, Vec::new()),
            false => excitation::read_excitations(
                &mut file,
                &excitation::Context {
                    rate_hz: head.rate_hz,
                    system,
                    channels,
                },
            ),
        };
        let (declared, parameters) =
            parameter::read_parameters(&mut file, system, damping.as_ref());
        if declared == 0 {
            let allowed = "must not be distributed without a [[parameter]]: nodes identify and \
                share parameters";
            head.refuse_distributed(diagnostics, allowed);
        }
        let task = filter_task(declared, &excitations);
        let mut plan = filter::read_filter(file.table("filter"), head.rate_hz, task);
        filter::check_particles(&file, &plan, head.distributed.as_ref());
        plan.outliers = outliers::read_outliers(file.table("outliers"), head.rate_hz);
        let mut noise_levels = match is_modal {
            true => Vec::new(),
            false => read_noise_levels(&file, &nodes.channels, &excitations),
        };
        for level in &mut noise_levels {
            level.adapted &= plan.noise_rule != NoiseRule::Fixed;
        }
        let all_parameters = (declared == parameters.len()).then_some(&parameters[..]);
        let classes = classes::read_classes(file.table("classes"), all_parameters, head.rate_hz);
        let fusion = fusion::read_fusion(
            file.table("fusion"),
            head.distributed.as_ref(),
            &file,
            &fusion::FusionContext {
                rate_hz: head.rate_hz,
                nodes: &nodes.nodes,
                has_classes: classes.is_some(),
            },
        );
        let parameter_spans = parameters.iter().map(|read| read.name.clone());
        let responses = response::read_responses(&mut file, system, parameter_spans);
        if !responses.is_empty() {
            let allowed = "must not be distributed with [[response]]: a station estimates \
                parameters, not the motion";
            head.refuse_distributed(diagnostics, allowed);
        }
        let band_limit = filter::read_band_limit(file.table("band-limit"), head.rate_hz);
        let ingest = filter::read_ingest(file.table("ingest"), head.rate_hz);
        let context = alert::Context {
            parameters: all_parameters,
            learn_s: modes
                .as_ref()
                .map_or(0.0, |modes| alert::learning_s(plan.half_life_s, modes)),
        };
        let alert_rules = alert::read_alerts(&mut file, &context);
        let judge = judge::read_judge(file.table("judge"));
        let modal = match file.table("modal") {
            None if is_modal && !file.contains("modal") => Some(Section::new(
                &self.empty,
                "modal",
                file.span_of("model"),
                diagnostics,
            )),
            section => section,
        };
        let updatable = modal::Updatable {
            parameters: all_parameters,
            is_linear: !is_modal && system.is_none_or(|system| system.hysteresis.is_none()),
            is_distributed: head.is_distributed(),
        };
        let modal = modal::read_modal(modal, head.rate_hz, &nodes, &updatable);
        let channel_list: Vec<_> = nodes.channels.iter().map(|read| &read.channel).collect();
        let record = record::read_record(file.table("record"), channels.map(|_| &channel_list[..]));
        let levels = (!nodes.incomplete && declared_excitations == excitations.len())
            .then_some(&noise_levels[..]);
        let simulation = simulation::read_simulation(
            file.table("simulation"),
            &simulation::Context {
                parameters: all_parameters,
                nodes: (!nodes.incomplete).then_some(&nodes.nodes[..]),
                levels,
            },
        );
        let conditions = condition::read_conditions(&mut file);
        let earthquakes = earthquakes::read_earthquakes(file.table("earthquakes"), &nodes);
        let coordinates = place::read_place(file.table("place"));
        file.finish();
        Some(Structure {
            text: self.text.to_owned(),
            name: head.name?,
            description: head.description,
            place: head.place,
            contact: head.contact,
            runbook: head.runbook,
            coordinates,
            sampling_rate_hz: head.rate_hz?,
            display_rate_hz: head.display_rate_hz,
            system: system?.clone(),
            damping_is_known,
            parameters: parameters.into_iter().map(|read| read.parameter).collect(),
            excitation_channels: excitations.iter().flat_map(component_channels).collect(),
            observation_channels: observation_channels(&nodes.channels),
            excitations: excitations
                .into_iter()
                .map(|read| read.excitation)
                .collect(),
            nodes: nodes.nodes,
            noise_levels,
            responses,
            plan,
            classes,
            fusion,
            band_limit,
            ingest: ingest?,
            alert_rules,
            judge,
            modal,
            record: record?,
            simulation,
            conditions,
            earthquakes,
            excitation_errors: Computed::default(),
            analysis_basis: Computed::default(),
            modes: Arc::new(modes?),
        })
    }
}

/// Tables that need a model.
const OF_MODELS: [&str; 12] = [
    "damping",
    "earthquakes",
    "excitation",
    "parameter",
    "filter",
    "outliers",
    "classes",
    "fusion",
    "response",
    "band-limit",
    "alert",
    "simulation",
];

fn read_head(file: &mut Section<'_>) -> Head {
    let mut head = Head {
        name: None,
        description: String::new(),
        place: String::new(),
        contact: String::new(),
        runbook: None,
        rate_hz: None,
        display_rate_hz: DISPLAY_RATE_HZ,
        distributed: None,
    };
    let Some(mut section) = file.required_table("structure") else {
        return head;
    };
    head.name = section.required_name("name").map(Spanned::into_inner);
    head.description = section
        .text("description")
        .map(Spanned::into_inner)
        .unwrap_or_default();
    head.place = section
        .text("place")
        .map(Spanned::into_inner)
        .unwrap_or_default();
    head.contact = section
        .text("contact")
        .map(Spanned::into_inner)
        .unwrap_or_default();
    head.runbook = section.link("runbook").map(Spanned::into_inner);
    head.rate_hz = section
        .required_number("sampling-rate-hz", Allowed::RATE)
        .map(Spanned::into_inner);
    head.distributed = section.choice("identification", &fusion::IDENTIFICATIONS);
    head.display_rate_hz = section.number_or("display-rate-hz", Allowed::POSITIVE, DISPLAY_RATE_HZ);
    section.finish();
    head
}

/// Reads `[model]` and `[damping]`, and refuses the tables that need a model if there is none.
fn read_dynamics(file: &mut Section<'_>) -> Dynamics {
    let model = file.required_table("model").and_then(model::read_model);
    let is_modal = model.as_ref().is_some_and(|read| read.system.is_empty());
    let damping = match is_modal {
        true => {
            file.refuse_keys(&OF_MODELS, model::WITHOUT_A_MODEL);
            None
        }
        false => file.required_table("damping"),
    };
    let damping = damping.and_then(|section| damping::read_damping(section, model.as_ref()));
    let damping_is_known = damping.as_ref().is_some_and(|read| read.is_known);
    let damping = damping.map(|read| read.damping);
    let (mut system, modes) = match model {
        Some(ModelRead { system, modes }) => (Some(system), Some(modes)),
        None => (None, None),
    };
    if let (Some(system), Some(damping)) = (&mut system, &damping) {
        system.damping = damping.clone();
    }
    Dynamics {
        system,
        modes,
        damping,
        damping_is_known,
        is_modal,
    }
}

/// Returns the task of the filter of a structure with this number of parameters.
fn filter_task(
    parameters: usize,
    excitations: &[excitation::ExcitationRead],
) -> filter::FilterTask {
    let is_measured = |read: &excitation::ExcitationRead| read.excitation.channel().is_some();
    filter::FilterTask {
        follows: match parameters {
            0 => filter::Follows::MotionAlone,
            _ => filter::Follows::Parameters,
        },
        measures: match excitations.iter().any(is_measured) {
            true => filter::Measures::Excitation,
            false => filter::Measures::ResponsesAlone,
        },
    }
}

/// Returns the channel of each component of an excitation.
fn component_channels(read: &excitation::ExcitationRead) -> impl Iterator<Item = Option<usize>> {
    std::iter::repeat_n(read.excitation.channel(), read.excitation.component_len())
}

/// Returns the frame channels of responses, in frame order.
fn observation_channels(channels: &[ChannelRead]) -> Vec<usize> {
    let responses = channels
        .iter()
        .enumerate()
        .filter(|(_, read)| !read.channel.quantity.is_excitation());
    responses.map(|(index, _)| index).collect()
}

/// Creates a noise level per excitation and per group of sensors.
///
/// A channel without a group gets its own noise level.
fn read_noise_levels(
    file: &Section<'_>,
    channels: &[ChannelRead],
    excitations: &[excitation::ExcitationRead],
) -> Vec<NoiseLevel> {
    let mut names: Vec<Spanned<String>> =
        excitations.iter().map(|read| read.name.clone()).collect();
    let of_excitation = |(index, read): (usize, &excitation::ExcitationRead)| NoiseLevel {
        name: read.excitation.name.clone(),
        std: read.excitation.unknown_std(),
        adapted: read.excitation.adapts,
        source: NoiseSource::Excitation(index),
    };
    let mut levels: Vec<NoiseLevel> = excitations.iter().enumerate().map(of_excitation).collect();
    let responses = channels
        .iter()
        .filter(|read| !read.channel.quantity.is_excitation());
    for (row, read) in responses.enumerate() {
        let group = read.noise_group.as_ref().map(|group| {
            levels.iter().position(|level| {
                matches!(level.source, NoiseSource::Sensors(_)) && level.name == *group.get_ref()
            })
        });
        match group.flatten().map(|index| &mut levels[index]) {
            Some(level) => {
                if let NoiseSource::Sensors(rows) = &mut level.source {
                    rows.push(row);
                }
                check_group(file, read, level);
            }
            None => {
                let name = read.noise_group.as_ref().unwrap_or(&read.name);
                names.push(name.clone());
                levels.push(NoiseLevel {
                    name: name.get_ref().clone(),
                    std: read.channel.noise_std,
                    adapted: read.adapts_noise,
                    source: NoiseSource::Sensors(vec![row]),
                });
            }
        }
    }
    check_unique(file, "noise", &names);
    levels
}

/// Checks that the channels of a noise group agree on their common variance.
fn check_group(file: &Section<'_>, read: &ChannelRead, level: &NoiseLevel) {
    let (same_std, same_choice) = (
        read.channel.noise_std == level.std,
        read.adapts_noise == level.adapted,
    );
    if !(same_std && same_choice) {
        let found = format!("differs from the others of noise group \"{}\"", level.name);
        let key = if same_std {
            "node.channel.adapt-noise"
        } else {
            "node.channel.noise-std"
        };
        file.diagnostics().report(
            read.name.span(),
            key,
            found,
            "must be the same within a group",
        );
    }
}

/// Reports every duplicate name.
fn check_unique(section: &Section<'_>, key: &str, names: &[Spanned<String>]) {
    for (index, name) in names.iter().enumerate() {
        if names[..index]
            .iter()
            .any(|earlier| earlier.get_ref() == name.get_ref())
        {
            let found = format!("repeats \"{}\"", name.get_ref());
            section
                .diagnostics()
                .report(name.span(), key, found, "must be unique");
        }
    }
}

/// Reads a time (s) and reports it if its number of samples is not in `samples`.
///
/// `rate_hz` is the sampling rate of the structure.
fn read_time(
    section: &mut Section<'_>,
    key: &'static str,
    rate_hz: Option<f64>,
    samples: RangeInclusive<usize>,
) -> Option<f64> {
    let time_s = section.number(key, Allowed::POSITIVE)?;
    let rate_hz = rate_hz?;
    let count = (time_s.get_ref() * rate_hz).round();
    let (least, most) = (*samples.start() as f64, *samples.end() as f64);
    if (least..=most).contains(&count) {
        return Some(time_s.into_inner());
    }
    let found = match count {
        few if few < least => {
            format!(
                "is {}, {} at {rate_hz} Hz",
                short(*time_s.get_ref()),
                counted(few as usize, "sample", "samples")
            )
        }
        _ => format!("is {}", short(*time_s.get_ref())),
    };
    let allowed = format!(
        "must be from {} to {}, which is {} to {} samples",
        short(least / rate_hz),
        short(most / rate_hz),
        samples.start(),
        samples.end()
    );
    section
        .diagnostics()
        .report(time_s.span(), section.key(key), found, allowed);
    None
}

/// Returns the index of a name in `known`, or reports an unknown name.
fn find_name<'k>(
    section: &Section<'_>,
    key: &str,
    name: &Spanned<String>,
    known: impl Iterator<Item = &'k str> + Clone,
) -> Option<usize> {
    let found = known.clone().position(|known| known == name.get_ref());
    if found.is_none() {
        let hint = one_of(name.get_ref(), known);
        section.diagnostics().report(
            name.span(),
            section.key(key),
            format!("is \"{}\"", name.get_ref()),
            hint,
        );
    }
    found
}

/// Returns the indices of names in `known`, or reports all unknown names.
fn find_names<'k>(
    section: &Section<'_>,
    key: &str,
    names: &[Spanned<String>],
    known: impl Iterator<Item = &'k str> + Clone,
) -> Option<Vec<usize>> {
    let find = |name| find_name(section, key, name, known.clone());
    let found: Vec<_> = names.iter().map(find).collect();
    found.into_iter().collect()
}

#[cfg(test)]
mod tests;
