//! What a person notes about a structure.

use serde::{Deserialize, Serialize};

use super::{Event, EventKind, Format, Malformed, Message, check_label, check_text};
use crate::name::Name;

/// Subject of an annotation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AnnotationKind {
    /// Somebody has looked at the structure.
    Inspection,
    /// The structure was repaired or strengthened.
    Repair,
    /// Maintenance, such as a new surface.
    Maintenance,
    /// Weather, such as a flood.
    Weather,
    /// Traffic, such as a closure or a heavy transport.
    Traffic,
    /// Anything else.
    Other,
}

impl AnnotationKind {
    /// All kinds.
    pub const ALL: [Self; 6] = [
        Self::Inspection,
        Self::Repair,
        Self::Maintenance,
        Self::Weather,
        Self::Traffic,
        Self::Other,
    ];

    /// Returns the name of the kind, as in the message.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Inspection => "inspection",
            Self::Repair => "repair",
            Self::Maintenance => "maintenance",
            Self::Weather => "weather",
            Self::Traffic => "traffic",
            Self::Other => "other",
        }
    }

    /// Returns the kind of this name. `None` if there is none.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.as_str() == name)
    }
}

/// Effect of an annotation on the judgement of lasting change.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AnnotationEffect {
    /// Nothing.
    #[default]
    None,
    /// Somebody has seen the lasting change that is known at this time.
    Seen,
    /// A new reference starts with the first epoch at or after [`Annotation::from_ns`].
    NewReference,
}

impl AnnotationEffect {
    /// Returns the name of the effect, as in the message.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Seen => "seen",
            Self::NewReference => "new-reference",
        }
    }
}

/// A note of a person about a structure or one judged quantity.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Annotation {
    /// Name of the structure.
    pub structure: Name,
    /// The judged quantity that the annotation concerns. `None` for all quantities.
    #[serde(default)]
    pub quantity: Option<Name>,
    /// Time of this message, ns since the Unix epoch, UTC, by the clock of the sender.
    pub time_ns: i64,
    /// Beginning of the annotated span, ns since the Unix epoch, UTC. At most `time_ns` if the
    /// annotation starts a new reference.
    pub from_ns: i64,
    /// End of the annotated span, ns since the Unix epoch, UTC. `None` for a moment.
    #[serde(default)]
    pub to_ns: Option<i64>,
    /// Subject of the annotation.
    pub kind: AnnotationKind,
    /// Effect of the annotation on the judgement.
    #[serde(default)]
    pub effect: AnnotationEffect,
    /// Name of the person; not empty, at most [`MAX_LABEL_BYTES`](super::MAX_LABEL_BYTES), without
    /// control characters.
    pub who: String,
    /// The text, or the reason of a new reference. It is not empty.
    pub text: String,
}

impl Annotation {
    /// Creates the annotation with which a person acknowledges the lasting loss of a quantity.
    ///
    /// `time_ns` is the present time, ns since the Unix epoch, UTC. An annotation always has a
    /// text, so that an empty note becomes `acknowledged`.
    #[must_use]
    pub fn acknowledging(
        structure: Name,
        quantity: Name,
        time_ns: i64,
        who: String,
        note: String,
    ) -> Self {
        Self {
            structure,
            quantity: Some(quantity),
            time_ns,
            from_ns: time_ns,
            to_ns: None,
            kind: AnnotationKind::Other,
            effect: AnnotationEffect::Seen,
            who,
            text: match note.trim().is_empty() {
                true => "acknowledged".to_owned(),
                false => note,
            },
        }
    }

    /// Returns `true` if the annotation concerns a quantity.
    #[must_use]
    pub fn covers(&self, quantity: &Name) -> bool {
        self.quantity.as_ref().is_none_or(|own| own == quantity)
    }

    /// Returns kind and effect in words, such as `repair: new reference`.
    #[must_use]
    pub fn what(&self) -> String {
        let kind = self.kind.as_str();
        match self.effect {
            AnnotationEffect::None => kind.to_owned(),
            AnnotationEffect::Seen if matches!(self.kind, AnnotationKind::Other) => {
                "acknowledged".to_owned()
            }
            AnnotationEffect::Seen => format!("{kind}: acknowledged"),
            AnnotationEffect::NewReference => format!("{kind}: new reference"),
        }
    }

    /// Returns the name of the person and the text, such as `ada: new bearings`.
    #[must_use]
    pub fn why(&self) -> String {
        format!("{}: {}", self.who, self.text)
    }

    /// Returns `true` if an event says that the service `judge` has kept the annotation.
    #[must_use]
    pub fn is_confirmed_by(&self, event: &Event) -> bool {
        let subject = self.quantity.as_ref().unwrap_or(&self.structure);
        event.kind == EventKind::Annotation
            && event.time_ns == self.from_ns
            && event.subject == subject.as_str()
            && event.what == self.what()
    }
}

impl Message for Annotation {
    const TYPE: &'static str = "annotation";
    const VERSION: u16 = 1;
    const FORMAT: Format = Format::Json;

    fn check(&self) -> Result<(), Malformed> {
        check_label("who", &self.who)?;
        check_text("text", &self.text)?;
        let texts = [
            ("length of who", &self.who),
            ("length of the text", &self.text),
        ];
        if let Some((what, _)) = texts.into_iter().find(|(_, text)| text.trim().is_empty()) {
            return Err(Malformed::Count {
                what,
                found: 0,
                least: 1,
                most: 4096,
            });
        }
        let seconds = |ns: i64| ns as f64 / 1e9;
        if let Some(to_ns) = self.to_ns.filter(|to_ns| *to_ns < self.from_ns) {
            return Err(Malformed::Range {
                what: "end (s)",
                found: seconds(to_ns),
                low: seconds(self.from_ns),
                high: f64::MAX,
            });
        }
        if self.effect == AnnotationEffect::NewReference && self.from_ns > self.time_ns {
            return Err(Malformed::Range {
                what: "beginning of a reference (s)",
                found: seconds(self.from_ns),
                low: f64::MIN,
                high: seconds(self.time_ns),
            });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn repair() -> Annotation {
        Annotation {
            structure: Name::new("bridge").unwrap(),
            quantity: Some(Name::new("pier").unwrap()),
            time_ns: 100,
            from_ns: 50,
            to_ns: None,
            kind: AnnotationKind::Repair,
            effect: AnnotationEffect::NewReference,
            who: "ada".to_owned(),
            text: "new bearings".to_owned(),
        }
    }

    #[test]
    fn an_annotation_has_a_name_and_a_text() {
        assert_eq!(repair().check(), Ok(()));
        assert_eq!(repair().what(), "repair: new reference");
        assert_eq!(repair().why(), "ada: new bearings");
        for (who, text) in [
            ("", "x"),
            (" ", "x"),
            ("ada", ""),
            ("ada", " \n"),
            ("a\nb", "x"),
        ] {
            let wrong = Annotation {
                who: who.to_owned(),
                text: text.to_owned(),
                ..repair()
            };
            assert!(wrong.check().is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn an_acknowledgement_without_a_note_is_valid() {
        let (structure, pier) = (Name::new("bridge").unwrap(), Name::new("pier").unwrap());
        let acknowledging = |note: &str| {
            let (who, note) = ("ada".to_owned(), note.to_owned());
            Annotation::acknowledging(structure.clone(), pier.clone(), 100, who, note)
        };
        assert_eq!(acknowledging(" ").check(), Ok(()));
        assert_eq!(acknowledging("").why(), "ada: acknowledged");
        let told = acknowledging("on my way");
        assert_eq!(told.why(), "ada: on my way");
        assert_eq!(told.effect, AnnotationEffect::Seen);
        assert!(told.covers(&pier));
    }

    #[test]
    fn an_annotation_is_confirmed_by_an_event_of_the_same_time_and_subject() {
        let event = Event {
            structure: Name::new("bridge").unwrap(),
            time_ns: 50,
            kind: EventKind::Annotation,
            subject: "pier".to_owned(),
            what: "repair: new reference".to_owned(),
            why: "ada: new bearings".to_owned(),
        };
        assert!(repair().is_confirmed_by(&event));
        let later = Event {
            time_ns: 51,
            ..event.clone()
        };
        assert!(!repair().is_confirmed_by(&later));
        let of_all = Annotation {
            quantity: None,
            ..repair()
        };
        assert!(!of_all.is_confirmed_by(&event));
        let of_bridge = Event {
            subject: "bridge".to_owned(),
            ..event
        };
        assert!(of_all.is_confirmed_by(&of_bridge));
    }

    #[test]
    fn a_reference_does_not_begin_in_the_future_and_nothing_ends_before_it_begins() {
        let future = Annotation {
            from_ns: 101,
            ..repair()
        };
        assert_eq!(
            future.check().unwrap_err().to_string(),
            "beginning of a reference (s) is 0.000000101, must be at most 0.0000001"
        );
        let planned = Annotation {
            effect: AnnotationEffect::None,
            ..future
        };
        assert_eq!(planned.check(), Ok(()));
        let backwards = Annotation {
            to_ns: Some(49),
            ..repair()
        };
        assert_eq!(
            backwards.check().unwrap_err().to_string(),
            "end (s) is 0.000000049, must be at least 0.00000005"
        );
    }

    #[test]
    fn an_annotation_without_a_quantity_concerns_all() {
        let (pier, deck) = (Name::new("pier").unwrap(), Name::new("deck").unwrap());
        assert!(repair().covers(&pier) && !repair().covers(&deck));
        let all = Annotation {
            quantity: None,
            ..repair()
        };
        assert!(all.covers(&pier) && all.covers(&deck));
    }

    #[test]
    fn names_are_those_of_the_json() {
        for kind in AnnotationKind::ALL {
            let json = serde_json::to_string(&kind).unwrap();
            assert_eq!(json, format!("\"{}\"", kind.as_str()));
            assert_eq!(AnnotationKind::from_name(kind.as_str()), Some(kind));
        }
        let effects = [
            AnnotationEffect::None,
            AnnotationEffect::Seen,
            AnnotationEffect::NewReference,
        ];
        for effect in effects {
            let json = serde_json::to_string(&effect).unwrap();
            assert_eq!(json, format!("\"{}\"", effect.as_str()));
        }
    }
}
