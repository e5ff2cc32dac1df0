//! The report of an event as one HTML page that prints on A4. It needs nothing else: no script, no
//! font and no connection.

use super::charts;
use super::event_record::is_same_period;
use super::judgement_table;
use super::report::{EventReport, SensorReport};
use super::wording::percent;
use spandrel_earthquake::Phase;
use spandrel_earthquake::motion::GRAVITY;
use std::fmt::Write as _;

/// Style sheet of all pages.
pub const STYLE: &str = include_str!("report.css");

/// Returns the text with the characters escaped that HTML treats specially.
pub fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for letter in text.chars() {
        match letter {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            other => escaped.push(other),
        }
    }
    escaped
}

/// Returns the head of a page with this title.
pub fn head(title: &str) -> String {
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <title>{}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n",
        escape(title)
    )
}

/// Returns the page of a report. `channels` are the samples of the sensors in its order, and
/// `occasion` says why they were recorded, or is empty.
pub fn html(report: &EventReport, channels: &[Vec<f64>], occasion: &str) -> String {
    let title = format!("{}: {}", report.structure, report.name.title());
    let mut page = head(&title);
    // Writing to a string cannot fail.
    let _ = write!(
        page,
        "<header>\n<p class=\"kicker\">Earthquake report</p>\n<h1>{}</h1>\n\
         <p class=\"when\">{}</p>\n</header>\n",
        escape(&report.structure),
        escape(format!("{} {occasion}", report.name.title()).trim_end()),
    );
    let _ = write!(
        page,
        "<section class=\"headline u{}\">\n<p class=\"badge\">{}</p>\n<p class=\"lead\">{}</p>\n\
         </section>\n",
        report.rank,
        escape(report.urgency.words()),
        escape(&report.headline)
    );
    page += "<section>\n";
    page += &list("What happened", &report.happened);
    page += &judgement_table::html(report);
    page += &list("What is not judged, and why", &report.not_judged);
    page += "</section>\n";
    page += &sensors(report);
    page += &displacements(report);
    page += &figure(
        "Accelerations",
        "All sensors on one scale. Each curve shows the smallest and largest samples.",
        &charts::accelerations(report, channels),
    );
    if !report.ground_spectra.is_empty() {
        page += &figure(
            "Response spectrum of the ground",
            "Pseudo-acceleration of an oscillator with 5 % damping.",
            &charts::spectra(report),
        );
    }
    for parameter in &report.parameters {
        page += &figure(
            &format!("Stiffness of {}", parameter.name),
            "Ratio to nominal in each window, with its 95 % interval within this record. Dashed: \
             the data contradict the model. Windows without a value contain no information.",
            &charts::stiffness(report, parameter),
        );
        if parameter.events.len() > 1 {
            page += &figure(
                &format!("Stiffness of {} in all events so far", parameter.name),
                "Points: weak motion, with the 95 % interval within the record. Triangles: softest \
                 window of the shaking. Band: what the events before this one predict.",
                &charts::events(report, parameter),
            );
            page += &comparison(parameter);
        }
    }
    page += &basis(report);
    page += "</main>\n</body>\n</html>\n";
    page
}

/// Returns a titled list of sentences. Empty without any.
pub fn list(title: &str, sentences: &[String]) -> String {
    if sentences.is_empty() {
        return String::new();
    }
    let items: String = sentences
        .iter()
        .map(|sentence| format!("<li>{}</li>\n", escape(sentence)))
        .collect();
    format!("<h2>{title}</h2>\n<ul>\n{items}</ul>\n")
}

fn figure(title: &str, caption: &str, svg: &str) -> String {
    format!(
        "<figure>\n<h2>{}</h2>\n{svg}<figcaption>{}</figcaption>\n</figure>\n",
        escape(title),
        escape(caption)
    )
}

fn sensors(report: &EventReport) -> String {
    let mut periods: Vec<f64> = Vec::new();
    for sensor in &report.sensors {
        let of_sensor: Vec<f64> = sensor
            .figures
            .spectrum
            .iter()
            .map(|one| one.period_s)
            .collect();
        if of_sensor.len() > periods.len() {
            periods = of_sensor;
        }
    }
    let own = report.fundamental_hz.recip();
    let mut text =
        "<section class=\"keep\">\n<h2>Peak and spectral values</h2>\n<table>\n<thead><tr>\
                    <th scope=\"col\">sensor</th><th scope=\"col\" class=\"n\">peak</th>\
                    <th scope=\"col\" class=\"n\">g</th>\
                    <th scope=\"col\" class=\"n\">Arias</th>\
                    <th scope=\"col\" class=\"n\">D5-95</th>"
            .to_owned();
    for period in &periods {
        let class = if is_same_period(*period, own) {
            "n own"
        } else {
            "n"
        };
        let _ = write!(
            text,
            "<th scope=\"col\" class=\"{class}\">Sa({})</th>",
            short(*period)
        );
    }
    text += "<th scope=\"col\">health</th></tr>\n\
             <tr class=\"unit\"><td></td><td class=\"n\">m/s²</td>\
             <td class=\"n\"></td><td class=\"n\">m/s</td><td class=\"n\">s</td>";
    for _ in &periods {
        text += "<td class=\"n\">m/s²</td>";
    }
    text += "<td></td></tr></thead>\n<tbody>\n";
    for sensor in &report.sensors {
        text += &sensor_row(sensor, &periods);
    }
    let _ = write!(
        text,
        "</tbody>\n</table>\n<p class=\"note\">Sa(T): pseudo-acceleration of an oscillator of \
         period T with 5 % damping; T = {} s is the first mode as designed. Arias: intensity over \
         the whole record. D5-95: time between 5 % and 95 % of it. Peaks are against the mean of \
         the record.</p>\n",
        short(own)
    );
    let faults = report.sensors.iter().filter_map(|sensor| {
        let fault = sensor.health.fault.as_ref()?;
        Some(format!(
            "{} {fault}: {}.",
            sensor.figures.channel,
            sensor.health.advice.unwrap_or("check it")
        ))
    });
    for fault in faults {
        let _ = writeln!(text, "<p class=\"warn\">{}</p>", escape(&fault));
    }
    text + "</section>\n"
}

/// Formats a period without trailing zeros.
fn short(period_s: f64) -> String {
    let text = format!("{period_s:.2}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

fn sensor_row(sensor: &SensorReport, periods: &[f64]) -> String {
    let figures = &sensor.figures;
    let dash = || "–".to_owned();
    let is_acceleration = figures.intensity.is_some();
    let peak = figures
        .motion
        .map_or_else(dash, |motion| match is_acceleration {
            true => format!("{:.2}", motion.peak),
            false => format!("{:.3e} {}", motion.peak, figures.unit),
        });
    let in_g = match (figures.motion, is_acceleration) {
        (Some(motion), true) => format!("{:.3}", motion.peak / GRAVITY),
        (Some(_) | None, _) => dash(),
    };
    let (arias, duration) = figures.intensity.map_or_else(
        || (dash(), dash()),
        |one| {
            (
                format!("{:.3}", one.arias_m_per_s),
                format!("{:.1}", one.significant_duration_s),
            )
        },
    );
    let mut row = format!(
        "<tr><th scope=\"row\">{}{}</th><td class=\"n\">{peak}</td><td class=\"n\">{in_g}</td>\
         <td class=\"n\">{arias}</td><td class=\"n\">{duration}</td>",
        escape(&figures.channel),
        if figures.is_excitation {
            " <small>ground</small>"
        } else {
            ""
        }
    );
    for period in periods {
        let value = figures
            .spectrum
            .iter()
            .find(|one| (one.period_s - period).abs() < 1e-9)
            .map_or_else(dash, |one| format!("{:.2}", one.sa_m_per_s2));
        let _ = write!(row, "<td class=\"n\">{value}</td>");
    }
    let class = if sensor.health.is_suspected() {
        "bad"
    } else {
        ""
    };
    let _ = writeln!(
        row,
        "<td class=\"{class}\">{}</td></tr>",
        escape(sensor.health.state)
    );
    row
}

fn displacements(report: &EventReport) -> String {
    if report.responses.is_empty() {
        return String::new();
    }
    let mut text =
        "<section class=\"keep\">\n<h2>Displacements and drifts</h2>\n<table>\n<thead><tr>\
                    <th scope=\"col\">estimate of the model</th>\
                    <th scope=\"col\" class=\"n\">peak (mm)</th>\
                    <th scope=\"col\" class=\"n\">± (mm)</th>\
                    <th scope=\"col\" class=\"n\">at (s)</th></tr></thead>\n<tbody>\n"
            .to_owned();
    for response in &report.responses {
        let _ = writeln!(
            text,
            "<tr><th scope=\"row\">{}</th><td class=\"n\">{:.2}</td><td class=\"n\">{:.2}</td>\
             <td class=\"n\">{:.1}</td></tr>",
            escape(&response.name),
            1e3 * response.peak,
            1e3 * response.std,
            response.at_s
        );
    }
    text + "</tbody>\n</table>\n<p class=\"note\">Relative to the ground, estimated with the \
            model and its standard deviation. If the data contradict the model in strong motion, \
            the values are rough.</p>\n</section>\n"
}

fn comparison(parameter: &super::report::ParameterReport) -> String {
    let mut text = "<section>\n<table>\n<thead><tr><th scope=\"col\">event</th>\
                    <th scope=\"col\" class=\"n\">weak motion</th>\
                    <th scope=\"col\" class=\"n\">within the record</th>\
                    <th scope=\"col\" class=\"n\">softest</th></tr></thead>\n<tbody>\n"
        .to_owned();
    for event in parameter.events.iter().rev() {
        let dash = || "–".to_owned();
        let number = |value: Option<f64>| value.map_or_else(dash, |value| format!("{value:.2}"));
        let within = event
            .within
            .map_or_else(dash, |one| format!("{:.2} to {:.2}", one.low, one.high));
        let _ = writeln!(
            text,
            "<tr><th scope=\"row\">{}</th><td class=\"n\">{}</td><td class=\"n\">{within}</td>\
             <td class=\"n\">{}</td></tr>",
            escape(&event.name.title()),
            number(event.stiffness),
            number(event.softest)
        );
    }
    text += "</tbody>\n</table>\n";
    if let Some(share) = parameter.coverage.share() {
        let _ = writeln!(
            text,
            "<p class=\"note\">Leave one event out: {} of {} events ({}) lie in the 95 % interval \
             that the others predict.</p>",
            parameter.coverage.inside,
            parameter.coverage.events,
            percent(share)
        );
    }
    text + "</section>\n"
}

/// What the report rests on: record, windows, fit and settings.
fn basis(report: &EventReport) -> String {
    let seconds = |phase: Phase| {
        let of_phase = report.windows.iter().filter(|window| window.phase == phase);
        of_phase
            .map(|window| window.end_s - window.start_s)
            .sum::<f64>()
    };
    let phases = [Phase::Quiet, Phase::Shaking, Phase::Settling, Phase::Weak]
        .map(|phase| format!("{} {:.0} s", phase.as_str(), seconds(phase)))
        .join(", ");
    let missing: Vec<String> = report
        .sensors
        .iter()
        .filter_map(|sensor| {
            let missing = sensor.figures.motion.map_or(0, |motion| motion.missing);
            (missing > 0).then(|| format!("{} {missing}", sensor.figures.channel))
        })
        .collect();
    let rows = [
        (
            "record",
            format!(
                "{}, {:.1} s at {} Hz",
                report.name.record, report.length_s, report.sampling_rate_hz
            ),
        ),
        (
            "missing samples",
            match missing.is_empty() {
                true => "none".to_owned(),
                false => missing.join(", "),
            },
        ),
        ("phases", phases),
        (
            "fit of the model",
            match &report.fit {
                Some(fit) => fit.words(),
                None => "not judged".to_owned(),
            },
        ),
        (
            "rules",
            format!(
                "strong motion: response above {} m/s²; a loss above {} is raised from \
                 probability {}",
                report.settings.strong_above_m_per_s2,
                percent(report.settings.loss),
                report.settings.credibility
            ),
        ),
        ("numbers", format!("{}.json", report.name.event)),
    ];
    let rows: String = rows
        .iter()
        .map(|(name, text)| format!("<dt>{name}</dt><dd>{}</dd>\n", escape(text)))
        .collect();
    let described = match report.description.is_empty() {
        true => String::new(),
        false => format!("<p class=\"note\">{}</p>\n", escape(&report.description)),
    };
    format!(
        "<section class=\"keep\">\n<h2>Basis</h2>\n{described}<dl>\n{rows}</dl>\n\
         <p class=\"note\">Softening in motion informs and is not damage. Only weak motion after \
         the shaking can show a lasting loss. A report does not replace an inspection.</p>\n\
         <p class=\"note\"><a href=\"index.html\">All reports</a></p>\n</section>\n"
    )
}
