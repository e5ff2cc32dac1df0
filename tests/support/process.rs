//! The built binary as a child process.

use super::DEADLINE;
use std::io::{Read, Write};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Condvar, Mutex};

/// Returns the built binary with an environment free of settings for it.
pub fn spandrel(subcommand: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_spandrel"));
    let ours = |name: &str| name.starts_with("SPANDREL_") || name == "RUST_LOG";
    for (name, _) in std::env::vars().filter(|(name, _)| ours(name)) {
        command.env_remove(name);
    }
    // Stored state must not reach the next test or the user of this machine.
    static PROCESSES: AtomicU32 = AtomicU32::new(0);
    let number = PROCESSES.fetch_add(1, Ordering::Relaxed);
    let state = format!(
        "{}/state-{}-{number}",
        env!("CARGO_TARGET_TMPDIR"),
        std::process::id()
    );
    let _ = std::fs::remove_dir_all(&state); // of an earlier process with this ID
    command
        .env("XDG_STATE_HOME", state)
        .env_remove("STATE_DIRECTORY")
        .arg(subcommand);
    command
}

/// A running process, which is killed when it is dropped.
pub struct Process {
    name: String,
    child: Child,
    stdout: Capture,
    stderr: Capture,
}

/// Exit code and output of a process.
#[derive(Debug)]
pub struct Finished {
    pub command: String,
    /// Exit code, or `None` after a signal.
    pub code: Option<i32>,
    pub stdout: String,
    pub stderr: String,
}

impl Process {
    pub fn start(command: &mut Command) -> Self {
        Self::spawn(command.stdin(Stdio::null()))
    }

    /// Starts a process that waits for input.
    pub fn start_with_input(command: &mut Command) -> Self {
        Self::spawn(command.stdin(Stdio::piped()))
    }

    /// Starts a process that reads a pipe, and returns the other end of the pipe.
    pub fn start_with_pipe(command: &mut Command) -> (Self, std::io::PipeWriter) {
        let (input, output) = std::io::pipe().unwrap();
        (Self::spawn(command.stdin(input)), output)
    }

    /// Starts a process whose standard error is a pipe without a reader.
    pub fn start_with_closed_log(command: &mut Command) -> Self {
        let (_, closed) = std::io::pipe().unwrap();
        Self::spawn_with_log(command.stdin(Stdio::null()), closed.into())
    }

    fn spawn(command: &mut Command) -> Self {
        Self::spawn_with_log(command, Stdio::piped())
    }

    fn spawn_with_log(command: &mut Command, log: Stdio) -> Self {
        let name = command
            .get_args()
            .map(|arg| arg.to_string_lossy())
            .collect::<Vec<_>>()
            .join(" ");
        let child = command.stdout(Stdio::piped()).stderr(log).spawn();
        let mut child =
            child.unwrap_or_else(|error| panic!("cannot start spandrel {name}: {error}"));
        let (stdout, stderr) = (
            Capture::of(child.stdout.take()),
            Capture::of(child.stderr.take()),
        );
        Self {
            name,
            child,
            stdout,
            stderr,
        }
    }

    /// Returns the processor time that it has used so far, s.
    pub fn processor_s(&self) -> f64 {
        /// Clock ticks per second in `/proc`, the same on all Linux platforms.
        const TICKS_PER_S: f64 = 100.0;
        let path = format!("/proc/{}/stat", self.child.id());
        let text = std::fs::read_to_string(path).unwrap();
        // The name in parentheses may contain blanks. Fields 14 and 15 are user and system time.
        let after_name = text.rsplit_once(')').unwrap().1;
        let ticks = after_name.split_whitespace().skip(11).take(2);
        ticks
            .map(|ticks| ticks.parse::<f64>().unwrap() / TICKS_PER_S)
            .sum()
    }

    /// Waits until standard error contains `text`.
    pub fn wait_for_log(&self, text: &str) {
        let said = self.stderr.wait_until(|said| said.contains(text));
        assert!(
            said.contains(text),
            "spandrel {}\n  expected in its log: {text}\n  found:\n{said}",
            self.name
        );
    }

    /// Waits until `is_there` returns `true` for its standard output.
    pub fn wait_for_output(&self, what: &str, is_there: impl Fn(&str) -> bool) {
        let said = self.stdout.wait_until(&is_there);
        assert!(
            is_there(&said),
            "spandrel {}\n  expected in its output: {what}\n  found:\n{said}",
            self.name
        );
    }

    /// Returns its standard output so far.
    pub fn output(&self) -> String {
        self.stdout.so_far()
    }

    /// Writes the line for which it waits.
    pub fn write_line(&mut self) {
        self.child.stdin.as_mut().unwrap().write_all(b"\n").unwrap();
    }

    /// Returns its standard error so far.
    pub fn log(&self) -> String {
        self.stderr.so_far()
    }

    /// Returns its process ID.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Returns `true` if it has ended by itself.
    pub fn has_ended(&mut self) -> bool {
        self.child.try_wait().unwrap().is_some()
    }

    /// Requests it to stop, as `systemctl stop` does.
    pub fn terminate(&self) {
        self.signal("-TERM");
    }

    /// Requests it to reload its configuration, as `systemctl reload` does.
    pub fn hang_up(&self) {
        self.signal("-HUP");
    }

    /// Suspends it at any point, as a machine that swaps or is migrated does.
    pub fn freeze(&self) {
        self.signal("-STOP");
    }

    /// Resumes it as if no time had passed.
    pub fn thaw(&self) {
        self.signal("-CONT");
    }

    fn signal(&self, signal: &str) {
        let sent = Command::new("kill")
            .args([signal, &self.child.id().to_string()])
            .status();
        assert!(
            sent.is_ok_and(|status| status.success()),
            "cannot signal spandrel {}",
            self.name
        );
    }

    /// Kills it without warning, as a power failure does.
    pub fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Waits until it ends by itself.
    pub fn wait(mut self) -> Finished {
        let stderr = self.stderr.wait_for_end();
        let stdout = self.stdout.wait_for_end();
        let (Some(stdout), Some(stderr)) = (stdout, stderr) else {
            panic!(
                "spandrel {} has not ended after {} s",
                self.name,
                DEADLINE.as_secs()
            );
        };
        let code = self.child.wait().unwrap().code();
        Finished {
            command: self.name.clone(),
            code,
            stdout,
            stderr,
        }
    }

    /// Requests it to stop, and waits until it has ended.
    pub fn stop(self) -> Finished {
        self.terminate();
        self.wait()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill(); // may have ended
        let _ = self.child.wait();
        if std::thread::panicking() {
            eprintln!(
                "--- spandrel {} said:\n{}---",
                self.name,
                self.stderr.so_far()
            );
        }
    }
}

impl Finished {
    /// Checks the exit code. The panic message contains the output.
    #[track_caller]
    pub fn expect_code(self, expected: i32) -> Self {
        let Self {
            command,
            code,
            stdout,
            stderr,
        } = &self;
        let told = format!("spandrel {command}\n  expected exit code {expected}, found {code:?}");
        assert!(
            *code == Some(expected),
            "{told}\n  standard output:\n{stdout}\n  standard error:\n{stderr}"
        );
        self
    }

    /// Checks that standard error contains all of `parts`.
    #[track_caller]
    pub fn expect_told(self, parts: &[&str]) -> Self {
        let Self {
            command, stderr, ..
        } = &self;
        for part in parts {
            assert!(
                stderr.contains(part),
                "spandrel {command}\n  expected on standard error: {part}\n  found:\n{stderr}"
            );
        }
        assert!(
            !stderr.contains("panicked"),
            "spandrel {command} panicked:\n{stderr}"
        );
        self
    }

    /// Checks that standard error contains none of `parts`.
    #[track_caller]
    pub fn expect_untold(self, parts: &[&str]) -> Self {
        let Self {
            command, stderr, ..
        } = &self;
        for part in parts {
            assert!(
                !stderr.contains(part),
                "spandrel {command}\n  not expected: {part}\n  found:\n{stderr}"
            );
        }
        self
    }
}

/// Output of a child's pipe, read by a separate thread.
struct Capture {
    said: Arc<(Mutex<Said>, Condvar)>,
}

struct Said {
    text: String,
    has_ended: bool,
}

impl Capture {
    /// Reads until the end, which comes at once without a pipe.
    fn of(pipe: Option<impl Read + Send + 'static>) -> Self {
        let said = Said {
            text: String::new(),
            has_ended: pipe.is_none(),
        };
        let said = Arc::new((Mutex::new(said), Condvar::new()));
        let Some(mut pipe) = pipe else {
            return Self { said };
        };
        let shared = said.clone();
        std::thread::spawn(move || {
            let mut buffer = [0; 8192];
            loop {
                let count = pipe.read(&mut buffer).unwrap_or(0);
                let mut said = shared.0.lock().unwrap();
                said.text
                    .push_str(&String::from_utf8_lossy(&buffer[..count]));
                said.has_ended = count == 0;
                shared.1.notify_all();
                if count == 0 {
                    return;
                }
            }
        });
        Self { said }
    }

    fn so_far(&self) -> String {
        self.said.0.lock().unwrap().text.clone()
    }

    /// Returns the output when `reached` returns `true`, at the end, or after the deadline.
    fn wait_until(&self, reached: impl Fn(&str) -> bool) -> String {
        let (said, changed) = &*self.said;
        let waits = |said: &mut Said| !said.has_ended && !reached(&said.text);
        changed
            .wait_timeout_while(said.lock().unwrap(), DEADLINE, waits)
            .unwrap()
            .0
            .text
            .clone()
    }

    /// Returns the complete output, or `None` if the deadline passes first.
    fn wait_for_end(&self) -> Option<String> {
        let (said, changed) = &*self.said;
        let (said, _) = changed
            .wait_timeout_while(said.lock().unwrap(), DEADLINE, |said| !said.has_ended)
            .unwrap();
        said.has_ended.then(|| said.text.clone())
    }
}
