//! What people note about a judged structure on the page.

use crate::api::Mistake;
use crate::entries::{person, text, wrong};
use crate::history::time;
use crate::judgements;
use crate::store::Store;
use axum::http::StatusCode;
use serde::Deserialize;
use spandrel_bus::{Annotation, AnnotationEffect, AnnotationKind, Name};

/// An annotation as the page sends it, before validation.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Noted {
    kind: AnnotationKind,
    text: String,
    who: String,
    #[serde(default)]
    effect: AnnotationEffect,
    /// `None` for all quantities.
    #[serde(default)]
    quantity: Option<String>,
    /// Seconds since the Unix epoch (UTC), or ISO 8601. `None` for now.
    #[serde(default)]
    from: Option<String>,
    /// As `from`. `None` for a moment.
    #[serde(default)]
    to: Option<String>,
}

impl Noted {
    /// Returns the annotation of a structure. `now_ns` is the wall-clock time (ns since the Unix
    /// epoch, UTC).
    pub(crate) fn annotation(&self, store: &Store, now_ns: i64) -> Result<Annotation, Mistake> {
        let structure = &store.about.name;
        let unknown = || {
            let allowed = "must be a structure with a table [judge]";
            let what = format!("structure `{structure}` is not judged");
            Mistake::new(StatusCode::NOT_FOUND, what, allowed)
        };
        if store.about.judged.is_empty() {
            return Err(unknown());
        }
        let quantity = self.quantity.as_deref();
        let quantity = quantity.map(|name| judgements::quantity(store, name));
        let quantity = quantity.transpose()?;
        let who = person(&self.who, "must be the name of the person who notes this")?;
        let text = text("text", &self.text)?;
        if text.is_empty() {
            return Err(wrong("text is empty", "must state what there is to note"));
        }
        let from_ns = time("from", self.from.as_ref(), now_ns)?;
        let to = self.to.as_ref();
        let to_ns = to.map(|to| time("to", Some(to), now_ns)).transpose()?;
        if from_ns > now_ns {
            let allowed = "must not be later than now, by the clock of the page";
            return Err(wrong("from is in the future", allowed));
        }
        if to_ns.is_some_and(|to_ns| to_ns < from_ns) {
            let allowed = "to must not come before from, or before now without from";
            return Err(wrong("to is before from", allowed));
        }
        Ok(Annotation {
            structure: Name::new(structure.as_str()).map_err(|_| unknown())?,
            quantity,
            time_ns: now_ns,
            from_ns,
            to_ns,
            kind: self.kind,
            effect: self.effect,
            who,
            text,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{demo, demo_with_air};
    use serde_json::{Value, json};
    use spandrel_bus::Message as _;

    const NOW_NS: i64 = 1_795_220_273_000_000_000;

    /// Returns the annotation that a repair with some more fields gives, or its mistake.
    fn noted(store: &Store, more: &Value) -> Result<Annotation, String> {
        let mut body = json!({"kind": "repair", "text": " new bearings ", "who": " Ada "});
        let fields = body.as_object_mut().unwrap();
        fields.extend(more.as_object().unwrap().clone());
        let noted: Noted = serde_json::from_value(body).map_err(|error| error.to_string())?;
        let annotation = noted.annotation(store, NOW_NS);
        annotation.map_err(|mistake| mistake.what().to_owned())
    }

    #[test]
    fn a_note_is_about_now_and_all_quantities_unless_it_says_otherwise() {
        let store = demo_with_air();
        let note = noted(&store, &json!({})).unwrap();
        assert_eq!(
            (note.from_ns, note.to_ns, &note.quantity, note.effect),
            (NOW_NS, None, &None, AnnotationEffect::None)
        );
        assert_eq!(
            (note.structure.as_str(), note.who.as_str(), &*note.text),
            ("demo", "Ada", "new bearings")
        );
        let more = json!({"effect": "new-reference", "quantity": "storey-2",
            "from": "2026-11-01", "to": "2027-11-02T12:00:00Z"});
        let new = noted(&store, &more).unwrap();
        assert_eq!(new.effect, AnnotationEffect::NewReference);
        assert_eq!(new.quantity.as_ref().map(Name::as_str), Some("storey-2"));
        assert!(new.from_ns < NOW_NS && new.to_ns > Some(NOW_NS));
        assert_eq!(new.check(), Ok(()));
    }

    #[test]
    fn mistakes_are_named() {
        let store = demo_with_air();
        let long = "a".repeat(1001);
        for (more, told) in [
            (json!({"text": " \n"}), "text is empty"),
            (json!({"text": long}), "text is too long"),
            (json!({"text": "a\u{7}"}), "text has control characters"),
            (json!({"who": " "}), "who is empty"),
            (json!({"kind": "party"}), "unknown variant `party`"),
            (json!({"effect": "loud"}), "unknown variant `loud`"),
            (json!({"quantity": "roof"}), "quantity `roof` is not judged"),
            (json!({"from": "soon"}), "from is `soon`"),
            (json!({"to": "later"}), "to is `later`"),
            (json!({"from": "2027-01-01"}), "from is in the future"),
            (
                json!({"from": "2026-11-02", "to": "2026-11-01"}),
                "to is before from",
            ),
            (json!({"until": "2026-11-01"}), "unknown field `until`"),
        ] {
            let error = noted(&store, &more).unwrap_err();
            assert!(error.contains(told), "{told}\n{error}");
        }
        let error = noted(&demo(), &json!({})).unwrap_err();
        assert_eq!(error, "structure `demo` is not judged");
    }
}
