//! Templates of subjects, texts and bodies, and the variables that they can use.

use crate::content::{Content, Report, iso_8601};
use minijinja::syntax::SyntaxConfig;
use minijinja::value::Serde;
use minijinja::{Environment, UndefinedBehavior, Value};
use serde_json::{Map, json};
use spandrel_bus::AlertMessage;

/// All variables of a template.
pub(crate) const VARIABLES: [&str; 36] = [
    "acknowledged_by",
    "advice",
    "contact",
    "credibility",
    "estimate",
    "estimate_std",
    "fit",
    "key",
    "kind",
    "lines",
    "link",
    "loss",
    "loss_high",
    "loss_high_within_record",
    "loss_level",
    "loss_low",
    "loss_low_within_record",
    "origin",
    "others",
    "part",
    "place",
    "quality",
    "reasons",
    "reference",
    "rule_credibility",
    "rule_loss",
    "runbook",
    "sentence",
    "since",
    "state",
    "structure",
    "test",
    "time",
    "title",
    "unanswered",
    "undecided",
];

/// An error in a template.
#[derive(Debug, PartialEq)]
pub(crate) struct TemplateFault {
    /// Line from 1, if it is known.
    pub(crate) line: Option<usize>,
    /// What is wrong.
    pub(crate) found: String,
    /// What is allowed.
    pub(crate) allowed: String,
}

/// A template whose syntax and variables have been checked.
#[derive(Debug)]
pub(crate) struct Template {
    environment: Environment<'static>,
    name: String,
}

impl Template {
    /// Parses a template and renders it with each of `samples`.
    ///
    /// The values are escaped for JSON if `name` ends with `.json`.
    pub(crate) fn parse(
        source: &str,
        name: &str,
        samples: &[Content],
    ) -> Result<Self, TemplateFault> {
        let mut environment = Environment::new();
        environment.set_undefined_behavior(UndefinedBehavior::Strict);
        // A line with nothing but a tag leaves no empty line.
        let syntax = SyntaxConfig::builder()
            .trim_blocks(true)
            .lstrip_blocks(true)
            .keep_trailing_newline(true)
            .build()
            .map_err(|error| fault(&error))?;
        environment.set_syntax(syntax);
        environment
            .add_template_owned(name.to_owned(), source.to_owned())
            .map_err(|error| fault(&error))?;
        let template = Self {
            environment,
            name: name.to_owned(),
        };
        if let Some(unknown) = template.unknown_variable() {
            return Err(TemplateFault {
                line: line_of(source, &unknown),
                found: format!("unknown variable `{unknown}`"),
                allowed: format!("a variable among {}", VARIABLES.join(", ")),
            });
        }
        for sample in samples {
            template.rendered(sample).map_err(|error| fault(&error))?;
        }
        Ok(template)
    }

    fn unknown_variable(&self) -> Option<String> {
        let template = self.environment.get_template(&self.name).ok()?;
        let is_global = |name: &String| self.environment.globals().any(|(own, _)| own == name);
        let unknown = template.undeclared_variables(false).into_iter();
        unknown
            .filter(|name| !VARIABLES.contains(&name.as_str()) && !is_global(name))
            .min()
    }

    fn rendered(&self, content: &Content) -> Result<String, minijinja::Error> {
        let template = self.environment.get_template(&self.name)?;
        template.render(Value::from(Serde(variables(content))))
    }

    /// Renders a notice.
    ///
    /// # Errors
    /// Returns the reason. The check at the start makes it unlikely.
    pub(crate) fn render(&self, content: &Content) -> Result<String, String> {
        self.rendered(content)
            .map_err(|error| format!("template {}: {error}", self.name))
    }
}

fn fault(error: &minijinja::Error) -> TemplateFault {
    let detail = error.detail().map(|detail| format!(": {detail}"));
    TemplateFault {
        line: error.line(),
        found: format!("{}{}", error.kind(), detail.unwrap_or_default()),
        allowed: "a MiniJinja template".to_owned(),
    }
}

/// Returns the first line that contains a name as a whole word.
fn line_of(source: &str, name: &str) -> Option<usize> {
    let is_of_word = |c: char| c.is_alphanumeric() || c == '_';
    let has_name = |line: &str| line.split(|c| !is_of_word(c)).any(|word| word == name);
    source.lines().position(has_name).map(|index| index + 1)
}

/// Returns all variables of a notice. A text without a value is empty.
pub(crate) fn variables(content: &Content) -> Map<String, serde_json::Value> {
    let circumstances = &content.circumstances;
    let unanswered = content.unanswered_s.map(in_words).unwrap_or_default();
    let mut all = Map::new();
    for name in VARIABLES {
        all.insert(name.to_owned(), json!(""));
    }
    let mut set = |name: &str, value: serde_json::Value| drop(all.insert(name.to_owned(), value));
    set("key", json!(content.key));
    set("structure", json!(content.structure()));
    set("title", json!(circumstances.title));
    set("place", json!(circumstances.place));
    set(
        "part",
        json!(content.part().map_or("", |part| part.as_str())),
    );
    set(
        "state",
        json!(content.state().map_or("", |state| state.as_str())),
    );
    set("sentence", json!(content.sentence()));
    set("time", json!(iso_8601(content.time_ns())));
    set("fit", json!(circumstances.fit));
    set("quality", json!(circumstances.quality));
    set("others", json!(circumstances.others));
    set("origin", json!(circumstances.origin.as_str()));
    set("advice", json!(circumstances.advice));
    set("link", json!(circumstances.link));
    set("contact", json!(circumstances.contact));
    set("runbook", json!(circumstances.runbook));
    set("unanswered", json!(unanswered));
    set("test", json!(content.is_test));
    set("lines", json!([]));
    set("reasons", json!([]));
    match &content.report {
        Report::Alert(alert) => {
            set("kind", json!("alert"));
            of_alert(alert, &mut set);
        }
        Report::Monitoring(display) => {
            set("kind", json!("monitoring"));
            set("reasons", json!(display.reasons));
            set("since", json!(iso_8601(display.since_ns)));
        }
        Report::Judgement(display) => {
            set("kind", json!("judgement"));
            let percent = |share: f64| json!(format!("{:.1} %", 100.0 * share));
            if let Some(change) = &display.change {
                set("since", json!(iso_8601(change.since_ns)));
                set("loss", percent(change.loss));
                set("loss_low", percent(change.interval.low));
                set("loss_high", percent(change.interval.high));
                set("loss_level", percent(change.interval.level));
            }
        }
        Report::Earthquake(_) => set("kind", json!("earthquake-report")),
        Report::Clock(change) => {
            set("kind", json!("clock"));
            set("reasons", json!([change.why]));
        }
        Report::Summary(summary) => {
            set("kind", json!("summary"));
            set("lines", json!(summary.lines));
        }
    }
    all
}

fn of_alert(alert: &AlertMessage, set: &mut impl FnMut(&str, serde_json::Value)) {
    let percent = |share: f64| json!(format!("{:.1} %", 100.0 * share));
    set("rule_loss", percent(alert.rule_loss));
    set("rule_credibility", percent(alert.rule_credibility));
    set("credibility", percent(alert.credibility));
    set("estimate", json!(format!("{:.4}", alert.mean)));
    set("estimate_std", json!(format!("{:.4}", alert.std)));
    if let Some(since_ns) = alert.since_ns {
        set("since", json!(iso_8601(since_ns)));
    }
    if let Some(reference) = alert.reference {
        set("reference", json!(format!("{reference:.4}")));
    }
    if let Some(loss) = alert.loss {
        set("loss", percent(loss));
    }
    if let Some(interval) = alert.loss_interval {
        set("loss_low", percent(interval.low));
        set("loss_high", percent(interval.high));
        set("loss_level", percent(interval.level));
    }
    let within = alert.loss_interval_within_record;
    if let Some(within) = within.filter(|within| Some(*within) != alert.loss_interval) {
        set("loss_low_within_record", percent(within.low));
        set("loss_high_within_record", percent(within.high));
    }
    if let Some(because) = alert.undecided_because {
        set("undecided", json!(because.words()));
    }
    if let Some(who) = &alert.acknowledged_by {
        set("acknowledged_by", json!(who));
    }
}

fn in_words(seconds: u64) -> String {
    match seconds {
        0..120 => format!("{seconds} s"),
        120..7200 => format!("{} min", seconds / 60),
        _ => format!("{} h", seconds / 3600),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::samples::samples;
    use crate::testing::{alert, of_alert as content_of};
    use spandrel_bus::AlertState;

    fn parse(source: &str, name: &str) -> Result<Template, TemplateFault> {
        Template::parse(source, name, &samples("house"))
    }

    #[test]
    fn template_renders_the_variables_of_a_notice() {
        let template = parse(
            "{{ part }} {{ loss }}\n{% for other in others %}\n- {{ other }}\n{% endfor %}\n",
            "a.txt",
        );
        let text = template
            .unwrap()
            .render(&content_of(&alert(20, AlertState::Raised)));
        assert_eq!(
            text.unwrap(),
            "storey-2 12.4 %\n- storey-1 pending: it has lost 6 %\n"
        );
    }

    #[test]
    fn json_template_escapes_its_values() {
        let template = parse("{\"text\": {{ sentence }}}", "a.json").unwrap();
        let mut alert = alert(20, AlertState::Raised);
        alert.why = "\"quoted\"\n".to_owned();
        let text = template.render(&content_of(&alert)).unwrap();
        let value: serde_json::Value = serde_json::from_str(&text).unwrap();
        assert_eq!(value["text"], "\"quoted\"\n");
    }

    #[test]
    fn unknown_variable_is_named_with_its_line_and_the_allowed_ones() {
        let fault = parse("{{ part }}\n{% if losss %}x{% endif %}", "a.txt").unwrap_err();
        assert_eq!(fault.line, Some(2));
        assert!(fault.found.contains("`losss`"), "{fault:?}");
        assert!(fault.allowed.contains("loss_low"), "{fault:?}");
    }

    #[test]
    fn bad_syntax_and_unknown_filters_are_named_with_their_line() {
        let fault = parse("first\n{% if part %}", "a.txt").unwrap_err();
        assert_eq!(fault.line, Some(2), "{fault:?}");
        let fault = parse("first\n\n{{ part | shout }}", "a.txt").unwrap_err();
        assert_eq!(fault.line, Some(3), "{fault:?}");
        assert!(fault.found.contains("shout"), "{fault:?}");
    }

    #[test]
    fn variables_are_the_documented_ones() {
        let documented = include_str!("../../../docs/notices.md");
        for sample in samples("house") {
            let names: Vec<String> = variables(&sample).keys().cloned().collect();
            assert_eq!(names, VARIABLES);
        }
        for name in VARIABLES {
            assert!(documented.contains(&format!("`{name}`")), "{name}");
        }
    }
}
