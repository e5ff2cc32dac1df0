//! The number of threads on which Zenoh receives.
//!
//! If a peer stops reading, Zenoh closes its connection after some seconds. To close a TCP
//! connection with unsent data, the operating system blocks the thread, because Zenoh sets the
//! option `SO_LINGER`. It blocks for 10 s by default, and for 1 s in this build
//! (`.cargo/config.toml`). By default, Zenoh receives on two threads. Two suspended subscribers
//! would then stop all reception of the process for this time.
//!
//! Zenoh reads the number of threads only from the environment. A program cannot change its own
//! environment safely, so it replaces itself.

use std::env;
use std::ffi::OsStr;
use std::io;
use std::os::unix::process::CommandExt;
use std::process::Command;

/// Variable with the settings of Zenoh's threads.
const VARIABLE: &str = "ZENOH_RUNTIME";
/// Number of connections that can be closed at the same time, and one more. Further ones are closed
/// a second later. A thread without work costs some kilobytes.
const SETTINGS: &str = "(rx: (worker_threads: 128))";

/// Starts the program again with threads for slow connections, unless the variable is set. Does not
/// return if that succeeds.
///
/// # Errors
/// Returns an error if the program cannot be started again. It can continue with Zenoh's default.
pub fn provide() -> io::Result<()> {
    if env::var_os(VARIABLE).is_some() {
        return Ok(());
    }
    let mut arguments = env::args_os();
    let name = arguments.next();
    let mut again = Command::new(env::current_exe()?);
    again.arg0(name.as_deref().unwrap_or(OsStr::new("spandrel")));
    Err(again.args(arguments).env(VARIABLE, SETTINGS).exec())
}
