//! The threads that run filters.

use std::num::NonZeroUsize;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::thread;

type Job = Box<dyn FnOnce() + Send>;

/// A fixed number of threads that process filter jobs in order of submission.
///
/// A structure submits one block at a time and waits for it. Its frames therefore stay in order
/// whichever thread processes them. Many structures share the threads. The queue contains at most
/// one job per structure, so its length is bounded.
#[derive(Debug, Clone)]
pub struct FilterPool {
    jobs: flume::Sender<Job>,
}

impl FilterPool {
    /// Starts the threads, which end when the last clone of the pool is dropped.
    ///
    /// # Errors
    /// Returns an error if the operating system cannot create a thread.
    pub fn start(threads: NonZeroUsize) -> std::io::Result<Self> {
        let (jobs, waiting) = flume::unbounded::<Job>();
        for index in 0..threads.get() {
            let waiting = waiting.clone();
            thread::Builder::new()
                .name(format!("filter-{index}"))
                .spawn(move || {
                    while let Ok(job) = waiting.recv() {
                        // A panic drops the data of the job and notifies its waiting task. The
                        // thread continues for all other structures. The panic hook has already
                        // reported the panic.
                        drop(catch_unwind(AssertUnwindSafe(job)));
                    }
                })?;
        }
        Ok(Self { jobs })
    }

    /// Waits until a thread has processed an empty job. Returns `false` if the pool has ended.
    pub async fn responds(&self) -> bool {
        self.run(|| ()).await.is_some()
    }

    /// Runs `work` on one of the threads and returns its result. `None` if it panicked or the pool
    /// has ended.
    pub(crate) async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Option<T> {
        let (done, result) = tokio::sync::oneshot::channel();
        let job: Job = Box::new(move || {
            // The waiting task may have been stopped.
            let _ = done.send(work());
        });
        self.jobs.send(job).ok()?;
        result.await.ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn pool_survives_the_panic_of_a_job() {
        let pool = FilterPool::start(NonZeroUsize::MIN).unwrap();
        assert_eq!(pool.run(|| 1).await, Some(1));
        assert_eq!(
            pool.run(|| if true { panic!("as it should") } else { 2 })
                .await,
            None
        );
        assert_eq!(pool.run(|| 3).await, Some(3));
    }
}
