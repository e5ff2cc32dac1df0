//! Pages of the book, followed as a reader would: their commands run as printed in an empty folder,
//! and their output is compared.
//!
//! A block ` ```sh ` runs and must succeed. A block ` ```sh service ` is a separate terminal, which
//! runs until the end of the page. The block ` ```text ` after either is its output, standard
//! output and errors together. It is compared line by line without empty lines. A line with `…`
//! alone matches any lines, and `…` within a line matches any words. `UPDATE_DOCS=1` rewrites an
//! output without `…` that differs, except that of a service.

use crate::support::Process;
use std::ops::Range;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use tempfile::TempDir;

/// Placeholder of omitted output.
const LEFT_OUT: &str = "…";

/// One block of commands, and the output that the page shows.
#[derive(Debug, PartialEq)]
struct Step {
    line: usize,
    script: String,
    is_service: bool,
    shown: Option<Vec<String>>,
    /// Number of lines of the page before the first line of `shown`.
    lines_before_shown: usize,
}

/// An output that differs from the page.
struct Changed {
    /// Lines of the page, from 0.
    place: Range<usize>,
    said: String,
}

/// A page, and the folder in which its commands run.
pub struct Page {
    path: PathBuf,
    steps: Vec<Step>,
    folder: TempDir,
}

impl Page {
    /// Opens a page of the book, with an empty folder.
    pub fn open(name: &str) -> Self {
        let path = root().join("docs").join(name);
        let steps = steps(&std::fs::read_to_string(&path).unwrap());
        assert!(!steps.is_empty(), "{} has no commands", path.display());
        Self {
            path,
            steps,
            folder: tempfile::tempdir().unwrap(),
        }
    }

    /// Copies a file into the folder that the page expects the reader to have there.
    pub fn have(&self, file: &Path) {
        std::fs::copy(file, self.folder.path().join(file.file_name().unwrap())).unwrap();
    }

    /// Unpacks a gzip file into the folder.
    pub fn have_unpacked(&self, packed: &Path, name: &str) {
        let unpacked = Command::new("gzip")
            .args(["-dc"])
            .arg(packed)
            .output()
            .unwrap();
        assert!(
            unpacked.status.success(),
            "{}: {}",
            packed.display(),
            String::from_utf8_lossy(&unpacked.stderr)
        );
        let file = self.folder.path().join(name);
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(file, unpacked.stdout).unwrap();
    }

    /// Reads a file that the commands have left in the folder.
    pub fn read(&self, name: &str) -> String {
        std::fs::read_to_string(self.folder.path().join(name)).unwrap()
    }

    /// Runs all commands, each block in a `shell`, and compares their output. Returns the number of
    /// compared blocks of output.
    pub fn follow(&self, shell: impl Fn() -> Command) -> usize {
        let mut services = Services(Vec::new());
        let mut compared = 0;
        let mut changed = Vec::new();
        for step in &self.steps {
            let told = format!("{}:{}:\n{}", self.path.display(), step.line, step.script);
            println!("{told}");
            let mut command = shell();
            self.prepare(&mut command, &step.script);
            if step.is_service {
                let service = Process::start(command.process_group(0));
                if let Some(shown) = &step.shown {
                    let shown = [shown.as_slice(), &[LEFT_OUT.to_owned()]].concat(); // more follows
                    service
                        .wait_for_output(&format!("what the page shows below\n{told}"), |said| {
                            differences(&shown, said).is_none()
                        });
                }
                services.0.push(service);
            } else {
                let output = command.stdin(Stdio::null()).output().unwrap();
                let said = String::from_utf8_lossy(&output.stdout);
                assert!(
                    output.status.success(),
                    "{told}\n  ends with {}, and says:\n{said}",
                    output.status
                );
                if let Some(shown) = &step.shown
                    && let Some(difference) = differences(shown, &said)
                {
                    let is_whole = !shown.iter().any(|line| line.contains(LEFT_OUT));
                    match is_whole && std::env::var_os("UPDATE_DOCS").is_some() {
                        true => changed.push(Changed {
                            place: step.lines_before_shown..step.lines_before_shown + shown.len(),
                            said: said.into_owned(),
                        }),
                        false => panic!("{told}\n  {difference}\n  it says:\n{said}"),
                    }
                }
            }
            compared += usize::from(step.shown.is_some());
        }
        self.rewrite(&changed);
        compared
    }

    /// Replaces outputs on the page, which are in its order.
    fn rewrite(&self, changed: &[Changed]) {
        if changed.is_empty() {
            return;
        }
        let page = std::fs::read_to_string(&self.path).unwrap();
        let mut lines: Vec<&str> = page.lines().collect();
        for Changed { place, said } in changed.iter().rev() {
            lines.splice(place.clone(), said.lines().map(str::trim_end));
        }
        std::fs::write(&self.path, lines.join("\n") + "\n").unwrap();
    }

    fn prepare(&self, command: &mut Command, script: &str) {
        let program = Path::new(env!("CARGO_BIN_EXE_spandrel"))
            .parent()
            .unwrap()
            .display()
            .to_string();
        let path = std::env::var("PATH").unwrap();
        let ours = |name: &str| name.starts_with("SPANDREL_") || name == "RUST_LOG";
        for (name, _) in std::env::vars().filter(|(name, _)| ours(name)) {
            command.env_remove(name);
        }
        command.args([
            "bash",
            "-euo",
            "pipefail",
            "-c",
            &format!("exec 2>&1\n{script}"),
        ]);
        command
            .current_dir(self.folder.path())
            .env("PATH", format!("{program}:{path}"));
        // Stored state must not reach the user of this machine.
        command
            .env("XDG_STATE_HOME", self.folder.path().join(".state"))
            .env_remove("STATE_DIRECTORY");
    }
}

/// Returns a shell on this machine.
pub fn here() -> Command {
    Command::new("env")
}

pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .canonicalize()
        .unwrap()
}

/// Terminals that are closed at the end, with all their processes.
struct Services(Vec<Process>);

impl Drop for Services {
    fn drop(&mut self) {
        for service in &self.0 {
            let _ = Command::new("kill")
                .args(["-TERM", "--", &format!("-{}", service.id())])
                .status(); // may have ended
        }
    }
}

fn steps(page: &str) -> Vec<Step> {
    let mut steps: Vec<Step> = Vec::new();
    let mut block: Option<(usize, &str, Vec<&str>)> = None;
    for (number, line) in page.lines().enumerate() {
        let Some(fence) = line.strip_prefix("```") else {
            if let Some((_, _, lines)) = &mut block {
                lines.push(line);
            }
            continue;
        };
        let Some((first, kind, lines)) = block.take() else {
            block = Some((number + 2, fence, Vec::new()));
            continue;
        };
        match kind {
            "sh" | "sh service" => {
                let is_service = kind == "sh service";
                steps.push(Step {
                    line: first,
                    script: lines.join("\n"),
                    is_service,
                    shown: None,
                    lines_before_shown: 0,
                });
            }
            "text" => {
                if let Some(last) = steps.last_mut().filter(|last| last.shown.is_none()) {
                    last.shown = Some(lines.into_iter().map(str::to_owned).collect());
                    last.lines_before_shown = first - 1;
                }
            }
            _ => {}
        }
    }
    steps
}

/// Returns the first line of a page that is missing in the output at its place.
fn differences(shown: &[String], said: &str) -> Option<String> {
    let said: Vec<&str> = said
        .lines()
        .filter(|line| !line.trim().is_empty())
        .collect();
    let mut next = 0;
    let mut may_skip = false;
    for line in shown
        .iter()
        .map(String::as_str)
        .filter(|line| !line.trim().is_empty())
    {
        if line.trim() == LEFT_OUT {
            may_skip = true;
            continue;
        }
        let rest = said.get(next..).unwrap_or_default();
        let place = rest.iter().position(|found| line_matches(line, found));
        match place {
            Some(skipped) if skipped == 0 || may_skip => next += skipped + 1,
            _ => return Some(format!("expected {line:?}, found {:?}", rest.first())),
        }
        may_skip = false;
    }
    match said.get(next) {
        Some(more) if !may_skip => Some(format!("it says more than the page shows: {more:?}")),
        _ => None,
    }
}

fn line_matches(shown: &str, said: &str) -> bool {
    let (shown, said): (Vec<&str>, Vec<&str>) = (
        shown.split_whitespace().collect(),
        said.split_whitespace().collect(),
    );
    words_match(&shown, &said)
}

fn words_match(shown: &[&str], said: &[&str]) -> bool {
    let Some((word, more)) = shown.split_first() else {
        return said.is_empty();
    };
    let Some(end) = word.strip_prefix(LEFT_OUT) else {
        return said.first().is_some_and(|found| word_matches(word, found))
            && words_match(more, &said[1..]);
    };
    (1..=said.len())
        .any(|taken| said[taken - 1].ends_with(end) && words_match(more, &said[taken..]))
}

/// Returns `true` if two words are equal.
///
/// Decimal numbers may differ by one unit of the last shown digit, because another processor type
/// may round a borderline value differently.
fn word_matches(shown: &str, said: &str) -> bool {
    if shown == said {
        return true;
    }
    let outer = |c: char| "(),;:".contains(c);
    let (a, b) = (shown.trim_matches(outer), said.trim_matches(outer));
    let dressed_alike = shown.replacen(a, "", 1) == said.replacen(b, "", 1);
    match (decimal(a), decimal(b)) {
        (Some((a, unit)), Some((b, other_unit))) => {
            dressed_alike && unit == other_unit && (a - b).abs() < 1.5 * unit
        }
        _ => false,
    }
}

/// Returns a number with decimals or an exponent, and the unit of its last digit.
fn decimal(text: &str) -> Option<(f64, f64)> {
    let (mantissa, exponent) = text.split_once('e').unwrap_or((text, "0"));
    let decimals = mantissa
        .split_once('.')
        .map_or(0, |(_, decimals)| decimals.len());
    if decimals == 0 && exponent == "0" {
        return None;
    }
    let exponent: i32 = exponent.parse().ok()?;
    Some((
        text.parse().ok()?,
        10_f64.powi(exponent - i32::try_from(decimals).ok()?),
    ))
}

#[cfg(test)]
mod tests {
    use super::{differences, steps};

    fn shown(text: &str) -> Vec<String> {
        text.lines().map(str::to_owned).collect()
    }

    #[test]
    fn matching_output_is_distinguished_from_other_output() {
        let said =
            "12000 frames\n\n  lower  1.0003 ± 0.0014\nalert since 2026-11-21 19:30:59 UTC; over\n";
        for right in [
            "12000 frames\n  lower  1.0003 ± 0.0014\nalert since …; over",
            "…\n  lower  1.0004 ± 0.0014\n…",
            "12000 frames\n…",
        ] {
            assert_eq!(differences(&shown(right), said), None, "{right}");
        }
        for wrong in [
            "12000 frames\n  lower  1.0005 ± 0.0014\n…", // off by two of the last digit
            "12001 frames\n…",                           // a count is exact
            "12000 frames\nalert since …; over",         // a line is missing without `…`
            "12000 frames",                              // more output follows
            "…\nalert since … GMT; over",
            "12000 frames\n  lower  1.000 ± 0.0014\n…", // different number of digits
        ] {
            assert!(differences(&shown(wrong), said).is_some(), "{wrong}");
        }
    }

    #[test]
    fn blocks_are_found_with_their_shown_output() {
        let page = "```text\nnot of a command\n```\n```sh\na\nb\n```\nprose\n```text\nsaid\n```\n\
                    ```sh service\nc\n```\n";
        let found = steps(page);
        assert_eq!(found.len(), 2);
        assert_eq!(
            (found[0].line, found[0].script.as_str(), found[0].is_service),
            (5, "a\nb", false)
        );
        assert_eq!(found[0].shown, Some(vec!["said".to_owned()]));
        assert_eq!(page.lines().nth(found[0].lines_before_shown), Some("said"));
        assert_eq!(
            (
                found[1].script.as_str(),
                found[1].is_service,
                &found[1].shown
            ),
            ("c", true, &None)
        );
    }
}
