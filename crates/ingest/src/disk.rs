//! The thread that writes recordings.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Mutex, PoisonError};
use std::thread;

type Job = Box<dyn FnOnce() + Send>;

/// The queue of the thread that writes the recordings of all structures in the process.
///
/// Blocks of all structures arrive at the same moments. With a thread per write, as many threads as
/// structures would wake twenty times per second for a few microseconds of work.
///
/// Each structure submits one job at a time and waits for it. The number of structures therefore
/// bounds the queue. A disk that hangs blocks recorded structures, but nothing else.
static JOBS: Mutex<Option<flume::Sender<Job>>> = Mutex::new(None);

/// Returns the queue of the thread, and starts the thread on the first call.
fn jobs() -> std::io::Result<flume::Sender<Job>> {
    let mut started = JOBS.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(jobs) = &*started {
        return Ok(jobs.clone());
    }
    let (jobs, waiting) = flume::unbounded::<Job>();
    thread::Builder::new()
        .name("recording".to_owned())
        .spawn(move || {
            while let Ok(job) = waiting.recv() {
                // The waiting structure receives an error. The panic hook has already reported the
                // panic.
                drop(catch_unwind(AssertUnwindSafe(job)));
            }
        })?;
    Ok(started.insert(jobs).clone())
}

/// A handle to the thread that writes recordings.
#[derive(Clone, Debug)]
pub(crate) struct DiskThread {
    jobs: flume::Sender<Job>,
}

impl DiskThread {
    /// Returns a handle, and starts the thread if it is not running.
    ///
    /// # Errors
    /// Returns an error if the operating system cannot start a thread.
    pub(crate) fn start() -> std::io::Result<Self> {
        Ok(Self { jobs: jobs()? })
    }

    /// Runs `work` on the thread and returns its result, or `None` if it panicked.
    pub(crate) async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Option<T> {
        let (done, result) = tokio::sync::oneshot::channel();
        // The waiting task may have been cancelled.
        let job: Job = Box::new(move || drop(done.send(work())));
        self.jobs.send(job).ok()?;
        result.await.ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn panic_of_a_write_does_not_affect_other_writes() {
        let (thread, other) = (DiskThread::start().unwrap(), DiskThread::start().unwrap());
        let name = || thread::current().name().map(str::to_owned);
        assert_eq!(thread.run(name).await, Some(Some("recording".to_owned())));
        assert_eq!(
            thread
                .run(|| if true { panic!("as it should") } else { 2 })
                .await,
            None
        );
        assert_eq!(other.run(|| 3).await, Some(3));
        assert_eq!(thread.run(|| 4).await, Some(4));
    }
}
