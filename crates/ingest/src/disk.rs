//! The thread that writes recordings.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Mutex, PoisonError};
use std::thread;

type Job = Box<dyn FnOnce() + Send>;

/// Writes for all structures of the process: their blocks come at the same moments, and a thread lent to each write would be as many
/// threads as structures, woken twenty times a second for some microseconds of work.
///
/// Each structure hands over one job at a time and waits for it, so that the queue is bounded by their number; a disk that hangs holds up
/// those that record, and nothing else.
static JOBS: Mutex<Option<flume::Sender<Job>>> = Mutex::new(None);

/// The queue of the thread, which is started for the first job.
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
                // its structure hears that it is lost; the panic itself has been reported where it happened
                drop(catch_unwind(AssertUnwindSafe(job)));
            }
        })?;
    Ok(started.insert(jobs).clone())
}

/// A handle on the thread.
#[derive(Clone, Debug)]
pub(crate) struct DiskThread {
    jobs: flume::Sender<Job>,
}

impl DiskThread {
    /// Starts it, unless another structure has.
    ///
    /// # Errors
    /// The system refuses a thread.
    pub(crate) fn start() -> std::io::Result<Self> {
        Ok(Self { jobs: jobs()? })
    }

    /// Carries out `work` and returns what it returns; `None` when it panicked.
    pub(crate) async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Option<T> {
        let (done, result) = tokio::sync::oneshot::channel();
        // whoever waited may have been stopped
        let job: Job = Box::new(move || drop(done.send(work())));
        self.jobs.send(job).ok()?;
        result.await.ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_write_that_panics_takes_no_other_with_it() {
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
