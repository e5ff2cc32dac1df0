//! Tests of the documentation: every link has a target, every page is in the book, the command-line
//! page matches the program, the table of crates matches the workspace, and no page contradicts the
//! program or itself about encodings, restarts and sensors.

use serde_json::Value;
use spandrel_bus::{
    Acknowledgement, AlertMessage, Annotation, EpochDisplay, EstimateBlock, Event, FeedbackMessage,
    Format, FrameBlock, LocalMessage, LossDisplay, Maintenance, Message, NoiseDisplay,
    ParameterDisplay, Progress, SampleBlock, StateMessage, Status,
};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .canonicalize()
        .unwrap()
}

/// Returns all pages below a folder.
fn pages(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if path.is_dir() && !name.starts_with('.') && name != "target" && name != "vendor" {
            pages(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "md") {
            found.push(path);
        }
    }
}

/// Returns a page without its code blocks.
fn prose(text: &str) -> String {
    let mut is_code = false;
    let lines = text.lines().filter(|line| {
        let is_fence = line.trim_start().starts_with("```");
        is_code ^= is_fence;
        !is_code && !is_fence
    });
    lines.collect::<Vec<_>>().join("\n")
}

/// Returns the anchor of a section title.
fn anchor(title: &str) -> String {
    let text = title.trim().to_lowercase();
    let kept = text
        .chars()
        .filter(|c| c.is_alphanumeric() || *c == ' ' || *c == '-' || *c == '_');
    kept.map(|c| if c == ' ' { '-' } else { c }).collect()
}

fn anchors(text: &str) -> BTreeSet<String> {
    let titles = prose(text)
        .lines()
        .filter(|line| line.starts_with('#'))
        .map(|line| anchor(line.trim_start_matches('#')))
        .collect::<Vec<_>>();
    titles.into_iter().collect()
}

/// Returns the targets of links and images.
fn links(text: &str) -> Vec<String> {
    let text = prose(text);
    let mut found = Vec::new();
    for (place, _) in text.match_indices("](") {
        let rest = &text[place + 2..];
        if let Some(end) = rest.find(')') {
            found.push(rest[..end].split(' ').next().unwrap().to_owned());
        }
    }
    found
}

#[test]
fn every_link_has_a_target() {
    let mut all = Vec::new();
    pages(&root(), &mut all);
    assert!(all.len() > 20, "{all:?}");
    let mut broken = Vec::new();
    let mut checked = 0;
    for page in &all {
        let text = std::fs::read_to_string(page).unwrap();
        for link in links(&text) {
            if link.contains("://") || link.starts_with("mailto:") {
                continue;
            }
            checked += 1;
            let (file, section) = link.split_once('#').unwrap_or((&link, ""));
            let target = if file.is_empty() {
                page.clone()
            } else {
                page.parent().unwrap().join(file)
            };
            let is_there = match (target.exists(), section) {
                (is_there, "") => is_there,
                (false, _) => false,
                (true, section) => {
                    anchors(&std::fs::read_to_string(&target).unwrap()).contains(section)
                }
            };
            if !is_there {
                broken.push(format!(
                    "{}: {link}",
                    page.strip_prefix(root()).unwrap().display()
                ));
            }
        }
    }
    assert!(checked > 100, "{checked} links");
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

#[test]
fn every_page_is_in_the_book() {
    let docs = root().join("docs");
    let mut all = Vec::new();
    pages(&docs, &mut all);
    let summary = std::fs::read_to_string(docs.join("SUMMARY.md")).unwrap();
    let listed: BTreeSet<PathBuf> = links(&summary)
        .into_iter()
        .map(|link| docs.join(link).canonicalize().unwrap())
        .collect();
    for page in all.iter().filter(|page| !page.ends_with("SUMMARY.md")) {
        assert!(
            listed.contains(page),
            "{} is not in docs/SUMMARY.md",
            page.display()
        );
    }
    // mdBook would write these pages outside the book.
    let outside: Vec<_> = listed
        .iter()
        .filter(|page| !page.starts_with(docs.canonicalize().unwrap()))
        .collect();
    assert!(outside.is_empty(), "outside of docs: {outside:?}");
}

/// The code on the page must equal the compiled example.
#[test]
fn the_subscriber_in_rust_equals_the_example() {
    let topics = std::fs::read_to_string(root().join("docs/topics.md")).unwrap();
    let (_, rest) = topics
        .split_once("\n### Rust\n")
        .expect("a section on Rust");
    let printed = rest
        .split_once("```rust\n")
        .and_then(|(_, code)| code.split_once("```"))
        .expect("its code")
        .0;
    let example = std::fs::read_to_string(root().join("crates/bus/examples/subscribe.rs")).unwrap();
    assert!(
        example.ends_with(printed),
        "docs/topics.md does not print crates/bus/examples/subscribe.rs"
    );
}

fn help(arguments: &[&str]) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_spandrel"));
    command.args(arguments).arg("--help").env("COLUMNS", "100");
    let output = command.output().unwrap();
    assert!(
        output.status.success(),
        "{arguments:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    let text = String::from_utf8(output.stdout).unwrap();
    text.lines()
        .map(str::trim_end)
        .collect::<Vec<_>>()
        .join("\n")
        .trim()
        .to_owned()
}

/// Returns the subcommands that a help text lists.
fn commands_of(help: &str) -> Vec<&str> {
    let Some((_, commands)) = help.split_once("\nCommands:\n") else {
        return Vec::new();
    };
    let commands = commands.lines().take_while(|line| !line.is_empty());
    let names = commands.filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    names
        .filter_map(|line| line.split_whitespace().next())
        .filter(|name| *name != "help")
        .collect()
}

/// Compares the page with the output of the program. `UPDATE_DOCS=1` rewrites the page.
#[test]
fn the_command_line_page_matches_the_program() {
    let whole = help(&[]);
    let names = commands_of(&whole);
    assert!(
        names.contains(&"demo") && names.contains(&"estimate"),
        "{names:?}"
    );
    let mut text = format!(
        "# Command line\n\nThis page contains the output of `spandrel --help` and \
         `spandrel COMMAND --help`.\n\n```text\n\
         {whole}\n```\n"
    );
    for name in names
        .iter()
        .filter(|name| name.chars().all(|c| c.is_ascii_lowercase()))
    {
        let of_command = help(&[name]);
        let _ = write!(text, "\n## {name}\n\n```text\n{of_command}\n```\n");
        for part in commands_of(&of_command) {
            let _ = write!(
                text,
                "\n### {name} {part}\n\n```text\n{}\n```\n",
                help(&[name, part])
            );
        }
    }
    let path = root().join("docs/command-line.md");
    if std::env::var_os("UPDATE_DOCS").is_some() {
        std::fs::write(&path, &text).unwrap();
    }
    let found = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        found == text,
        "docs/command-line.md differs from the help of the program; UPDATE_DOCS=1 rewrites it"
    );
}

/// The crates of the workspace without the prefix `spandrel-`, each with the crates on which it
/// depends.
type Crates = BTreeMap<String, BTreeSet<String>>;

/// Returns the members of the workspace and their normal dependencies on each other.
fn crates_of_the_workspace() -> Crates {
    let mut command = Command::new(env!("CARGO"));
    command.args(["metadata", "--no-deps", "--offline", "--format-version=1"]);
    let output = command.current_dir(root()).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "cargo metadata: {said}");
    let metadata: Value = serde_json::from_slice(&output.stdout).unwrap();
    let name = |of: &Value| of["name"].as_str().unwrap().to_owned();
    let packages = metadata["packages"].as_array().unwrap();
    let members: BTreeSet<String> = packages.iter().map(name).collect();
    let short = |name: String| name.trim_start_matches("spandrel-").to_owned();
    let depends_on = |package: &Value| {
        let all = package["dependencies"].as_array().unwrap().iter();
        let normal = all.filter(|dependency| dependency["kind"].is_null());
        let own = normal.map(name).filter(|name| members.contains(name));
        own.map(short).collect()
    };
    packages
        .iter()
        .map(|package| (short(name(package)), depends_on(package)))
        .collect()
}

/// Returns the rows of the table "Crates" of docs/architecture.md. `known` are the names to which
/// "all but" refers.
fn crates_of_the_page(known: &BTreeSet<String>) -> Crates {
    let page = std::fs::read_to_string(root().join("docs/architecture.md")).unwrap();
    let (_, section) = page.split_once("\n## Crates\n").expect("a section Crates");
    let (section, _) = section.split_once("\n## ").unwrap_or((section, ""));
    let rows = section.lines().filter(|line| line.starts_with("| ["));
    let list = |text: &str| -> BTreeSet<String> { text.split(", ").map(str::to_owned).collect() };
    let mut crates = Crates::new();
    for row in rows {
        let cells: Vec<&str> = row.trim_matches('|').split(" | ").map(str::trim).collect();
        let [title, _, _, depends_on] = cells[..] else {
            panic!("a row of the table Crates must have four cells: {row}");
        };
        let (name, _) = title[1..].split_once(']').expect("the name is a link");
        let mut depends_on = match depends_on.strip_prefix("all but ") {
            Some(others) => known.difference(&list(others)).cloned().collect(),
            None if depends_on == "none" => BTreeSet::new(),
            None => list(depends_on),
        };
        depends_on.remove(name); // "all" does not include the crate itself
        let earlier = crates.insert(name.to_owned(), depends_on);
        assert!(earlier.is_none(), "{name} has two rows in the table Crates");
    }
    crates
}

#[test]
fn the_table_of_crates_lists_the_workspace_and_its_dependencies() {
    let expected = crates_of_the_workspace();
    let found = crates_of_the_page(&expected.keys().cloned().collect());
    let mut wrong = String::new();
    for name in expected.keys().filter(|name| !found.contains_key(*name)) {
        let _ = writeln!(wrong, "{name} has no row");
    }
    for (name, written) in &found {
        match expected.get(name) {
            None => {
                let _ = writeln!(wrong, "{name} has a row, but is not a workspace member");
            }
            Some(depends_on) if depends_on != written => {
                let missing: Vec<_> = depends_on.difference(written).collect();
                let extra: Vec<_> = written.difference(depends_on).collect();
                let _ = writeln!(wrong, "{name}: missing {missing:?}, not used {extra:?}");
            }
            Some(_) => {}
        }
    }
    assert!(
        wrong.is_empty(),
        "table Crates of docs/architecture.md, compared with cargo metadata:\n{wrong}"
    );
}

/// Returns the page below `docs/`.
fn page(name: &str) -> String {
    std::fs::read_to_string(root().join("docs").join(name)).unwrap()
}

/// Checks that a table of topics names the accepted formats of a message.
fn assert_format_is_stated<M: Message>(topics: &str) {
    let expected = match M::ACCEPTED {
        [Format::Postcard] => "postcard",
        [Format::Json] => "JSON",
        _ => "postcard or [JSON](#samples-as-json)",
    };
    let link = format!("[{}](#", M::TYPE);
    let rows = topics.lines().filter(|line| line.starts_with("| `"));
    let rows = rows.map(|line| line.split(" | ").collect::<Vec<_>>());
    let row = rows
        .into_iter()
        .find(|row| row.len() == 5 && row[4].starts_with(&link));
    let row = row.unwrap_or_else(|| panic!("docs/topics.md has no topic of {}", M::TYPE));
    assert_eq!(row[3], expected, "{}", M::TYPE);
}

/// Regression test: the page said that JSON is accepted everywhere.
#[test]
fn the_page_of_topics_states_which_messages_are_accepted_as_json() {
    let topics = page("topics.md");
    assert_format_is_stated::<SampleBlock>(&topics);
    assert_format_is_stated::<FrameBlock>(&topics);
    assert_format_is_stated::<EstimateBlock>(&topics);
    assert_format_is_stated::<LocalMessage>(&topics);
    assert_format_is_stated::<FeedbackMessage>(&topics);
    assert_format_is_stated::<StateMessage>(&topics);
    assert_format_is_stated::<Progress>(&topics);
    assert_format_is_stated::<ParameterDisplay>(&topics);
    assert_format_is_stated::<LossDisplay>(&topics);
    assert_format_is_stated::<EpochDisplay>(&topics);
    assert_format_is_stated::<NoiseDisplay>(&topics);
    assert_format_is_stated::<AlertMessage>(&topics);
    assert_format_is_stated::<Acknowledgement>(&topics);
    assert_format_is_stated::<Maintenance>(&topics);
    assert_format_is_stated::<Annotation>(&topics);
    assert_format_is_stated::<Event>(&topics);
    assert_format_is_stated::<Status>(&topics);
    // The text below the table does not extend this to the messages in postcard.
    let plain = "Receivers of messages in JSON also accept plain `application/json`";
    let text = topics.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(text.contains(plain), "docs/topics.md lacks: {plain}");
}

/// Regression test: the page said that the alert service learns again after every restart.
#[test]
fn the_limits_of_a_restart_apply_only_without_a_state_folder() {
    let limits = page("limits.md");
    let items: Vec<String> = prose(&limits)
        .split("\n- ")
        .map(|item| item.split_whitespace().collect::<Vec<_>>().join(" "))
        .collect();
    let of_alert: Vec<&String> = items
        .iter()
        .filter(|item| item.contains("alert service loses"))
        .collect();
    assert_eq!(of_alert.len(), 1, "{of_alert:?}");
    let condition = "Without a [state folder](reliability.md), ";
    assert!(of_alert[0].starts_with(condition), "{}", of_alert[0]);
}

/// The file of the tutorial is that of the examples, which readers can copy.
#[test]
fn the_tutorial_on_a_year_prints_its_structure_file() {
    let path = root().join("docs/examples/judge/footbridge.toml");
    let file = std::fs::read_to_string(path).unwrap();
    let command = format!("cat > footbridge.toml <<'END'\n{file}END\n");
    assert!(
        page("year.md").contains(&command),
        "docs/year.md does not print docs/examples/judge/footbridge.toml"
    );
}

/// Regression test: the page contradicted its own structure file about a sensor.
#[test]
fn the_tutorial_agrees_with_its_structure_file_about_the_sensors() {
    let start = page("start.md");
    let (_, file) = start.split_once("house.toml <<'END'\n").unwrap();
    let (file, _) = file.split_once("\nEND\n").unwrap();
    let file: toml::Table = file.parse().unwrap();
    let channels = file["node"].as_array().unwrap().iter();
    let channels = channels.flat_map(|node| node["channel"].as_array().unwrap());
    let measured: BTreeSet<&str> = channels
        .filter_map(|channel| channel.get("dof")?.as_str())
        .collect();
    assert_eq!(measured, ["floor-1", "floor-3"].into());
    let text = prose(&start)
        .split_whitespace()
        .collect::<Vec<_>>()
        .join(" ");
    let words = "although the second floor has no sensor";
    assert!(text.contains(words), "docs/start.md lacks: {words}");
    let description = file["structure"]["description"].as_str().unwrap();
    assert!(description.ends_with("in the cellar, on the first floor and on the roof"));
}
