//! Seats: threads that exactly one statement has at a time, from its planning to its last row. The kernel shares the
//! processors among statements, and processor time has one statement to blame.

use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Duration;

use echolake_functions::StopFlag;
use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::blame::{StatementBlame, StatementOwner};
use super::thread_clock::{ThreadClock, ThreadTimes};
use super::threads::QueryThreads;

/// Seats that are kept without a statement, for the next ones.
const IDLE_SEATS: usize = 4;

/// One thread per core, and what they have computed.
struct QuerySeat {
    threads: QueryThreads,
    clock: Arc<ThreadClock>,
    /// Set once the statement has ended.
    stop: StopFlag,
}

impl QuerySeat {
    fn start(niceness: Option<i32>) -> std::io::Result<Self> {
        let clock = Arc::<ThreadClock>::default();
        let (begun, ended) = (clock.clone(), clock.clone());
        let stop = StopFlag::default();
        let watched = stop.clone();
        let begin = move || {
            begun.add_thread();
            watched.watch_thread();
            if let Some(niceness) = niceness {
                // Of this thread alone, on Linux. Only an administrator may lower it; then it stays as it is.
                let _ = rustix::process::setpriority_process(None, niceness);
            }
        };
        Ok(Self { threads: QueryThreads::with_hooks("query", begin, move || ended.remove_thread())?, clock, stop })
    }

    // Dropped tasks end at their next await. Connections to object stores are not theirs, see `store_threads.rs` of `storage/`.
    fn is_idle(&self) -> bool {
        self.threads.handle().is_none_or(|threads| threads.metrics().num_alive_tasks() == 0)
    }
}

/// The seats of a process.
pub(crate) struct SeatPool {
    niceness: Option<i32>,
    /// The seats that statements may have at a time.
    places: Arc<Semaphore>,
    state: Mutex<PoolState>,
}

/// Right to a seat; None from a pool that is closed, which no pool is.
pub(crate) type SeatPlace = Option<OwnedSemaphorePermit>;

#[derive(Default)]
struct PoolState {
    /// The one that was used last is taken first.
    idle: Vec<QuerySeat>,
    /// Seats whose statements have ended, with tasks that still live.
    draining: Vec<DrainingSeat>,
}

struct DrainingSeat {
    seat: QuerySeat,
    owner: Arc<StatementOwner>,
    /// What its threads had computed at the first look after the statement's end.
    times: OnceLock<ThreadTimes>,
}

/// A statement's seat. When this is dropped, it goes back to the pool once the statement's tasks have ended.
pub(crate) struct HeldSeat {
    seat: Option<QuerySeat>,
    pool: Arc<SeatPool>,
    owner: Arc<StatementOwner>,
    times: OnceLock<ThreadTimes>,
    _place: SeatPlace,
}

impl HeldSeat {
    /// Returns the handle of its threads; None during shutdown.
    pub fn handle(&self) -> Option<&Handle> {
        self.seat.as_ref()?.threads.handle()
    }

    /// Ends the calls of functions that are still to come.
    pub fn stop_calls(&self) {
        if let Some(seat) = &self.seat {
            seat.stop.set_stopped(true);
        }
    }

    /// Blames the statement if it has ended, and a thread has computed for more than `grace` since the first such look.
    pub fn find_blame(&self, grace: Duration) -> Option<StatementBlame> {
        blame_owner(self.seat.as_ref()?, &self.owner, &self.times, grace)
    }
}

impl Drop for HeldSeat {
    fn drop(&mut self) {
        self.stop_calls();
        if let Some(seat) = self.seat.take() {
            let times = std::mem::take(&mut self.times);
            self.pool.return_seat(DrainingSeat { seat, owner: self.owner.clone(), times });
        }
    }
}

impl fmt::Debug for HeldSeat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("HeldSeat").field("owner", &self.owner).finish_non_exhaustive()
    }
}

impl SeatPool {
    /// Creates a pool without seats, whose threads will have this niceness; None for that of the process. At most
    /// `most` statements have a seat at a time; None for any number.
    pub fn new(niceness: Option<i32>, most: Option<usize>) -> Arc<Self> {
        let places = Arc::new(Semaphore::new(most.unwrap_or(Semaphore::MAX_PERMITS)));
        Arc::new(Self { niceness, places, state: Mutex::default() })
    }

    /// Waits until a statement may have a seat.
    pub async fn wait_for_place(&self) -> SeatPlace {
        self.places.clone().acquire_owned().await.ok()
    }

    /// Takes an idle seat, or starts one.
    ///
    /// # Errors
    /// If the system cannot start its threads.
    pub fn take_seat(self: &Arc<Self>, owner: &Arc<StatementOwner>, place: SeatPlace) -> std::io::Result<HeldSeat> {
        let (idle, surplus) = {
            let mut state = self.lock();
            let surplus = state.collect_drained();
            (state.idle.pop(), surplus)
        };
        drop(surplus);
        let seat = match idle {
            Some(seat) => seat,
            None => QuerySeat::start(self.niceness)?,
        };
        seat.stop.set_stopped(false);
        let (pool, owner, times) = (self.clone(), owner.clone(), OnceLock::new());
        Ok(HeldSeat { seat: Some(seat), pool, owner, times, _place: place })
    }

    /// Returns a statement that has ended and given its seat back, and on whose seat a thread has computed for more than
    /// `grace` since.
    pub fn find_runaway(&self, grace: Duration) -> Option<StatementBlame> {
        let mut state = self.lock();
        let surplus = state.collect_drained();
        let found = state.draining.iter().find_map(|left| blame_owner(&left.seat, &left.owner, &left.times, grace));
        drop(state);
        drop(surplus);
        found
    }

    fn return_seat(&self, left: DrainingSeat) {
        let surplus = {
            let mut state = self.lock();
            state.draining.push(left);
            state.collect_drained()
        };
        drop(surplus);
    }

    fn lock(&self) -> MutexGuard<'_, PoolState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl PoolState {
    // Seats without tasks are idle; returns those that are too many.
    fn collect_drained(&mut self) -> Vec<QuerySeat> {
        for left in std::mem::take(&mut self.draining) {
            match left.seat.is_idle() {
                true => self.idle.push(left.seat),
                false => self.draining.push(left),
            }
        }
        let surplus = self.idle.len().saturating_sub(IDLE_SEATS);
        self.idle.drain(..surplus).collect()
    }
}

fn blame_owner(
    seat: &QuerySeat,
    owner: &StatementOwner,
    times: &OnceLock<ThreadTimes>,
    grace: Duration,
) -> Option<StatementBlame> {
    let before = times.get_or_init(|| seat.clock.read_times());
    (seat.clock.busiest_since(before) > grace).then(|| owner.blame())
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;
    use std::time::Instant;

    use super::*;

    const END_LIMIT: Duration = Duration::from_secs(60);

    fn owner() -> Arc<StatementOwner> {
        Arc::new(StatementOwner::new("somebody".into(), None))
    }

    fn address(held: &HeldSeat) -> usize {
        Arc::as_ptr(&held.seat.as_ref().expect("a seat").clock).addr()
    }

    fn wait_until(mut is_met: impl FnMut() -> bool, what: &str) {
        let begun = Instant::now();
        while !is_met() {
            assert!(begun.elapsed() < END_LIMIT, "{what}");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    #[test]
    fn a_seat_has_one_statement_and_is_reused_without_its_tasks() {
        let pool = SeatPool::new(None, None);
        let (first, second) =
            (pool.take_seat(&owner(), None).expect("threads"), pool.take_seat(&owner(), None).expect("threads"));
        let (first_seat, second_seat) = (address(&first), address(&second));
        assert_ne!(first_seat, second_seat);
        let (release, released) = mpsc::channel::<()>();
        let task = first.handle().expect("it runs").spawn(async move { released.recv() });
        drop(first);
        drop(second);
        let third = pool.take_seat(&owner(), None).expect("threads");
        assert_eq!(address(&third), second_seat, "the first is not idle");
        drop(release);
        wait_until(|| task.is_finished(), "the task ends");
        let mut reused = Vec::new();
        wait_until(
            || {
                reused.push(pool.take_seat(&owner(), None).expect("threads"));
                reused.last().is_some_and(|held| address(held) == first_seat)
            },
            "the seat is idle",
        );
        drop(reused);
        drop(third);
        assert!(pool.lock().idle.len() <= IDLE_SEATS);
    }

    #[tokio::test]
    async fn no_more_statements_have_a_seat_than_may() {
        let pool = SeatPool::new(None, Some(2));
        let mut held = Vec::new();
        for _ in 0..2 {
            let place = pool.wait_for_place().await;
            held.push(pool.take_seat(&owner(), place).expect("threads"));
        }
        let waiting = pool.clone();
        let third = tokio::spawn(async move { waiting.wait_for_place().await });
        tokio::task::yield_now().await;
        assert!(!third.is_finished(), "two have one");
        held.pop();
        third.await.expect("its place");
    }

    #[test]
    fn threads_have_the_niceness_of_their_pool() {
        let pool = SeatPool::new(Some(7), None);
        let held = pool.take_seat(&owner(), None).expect("threads");
        let threads = held.handle().expect("it runs").clone();
        let ask = |threads: &Handle| threads.block_on(async { tokio::spawn(async { own_niceness() }).await });
        assert_eq!(ask(&threads).expect("no panic"), 7);
        let blocking = threads.block_on(async { tokio::task::spawn_blocking(own_niceness).await });
        assert_eq!(blocking.expect("no panic"), 7, "a thread that another one starts is as nice");
        assert_ne!(own_niceness(), 7, "this one is not");
    }

    fn own_niceness() -> i32 {
        rustix::process::getpriority_process(None).expect("a priority")
    }

    #[test]
    fn what_computes_after_its_statement_is_blamed_on_it_and_a_task_that_waits_is_not() {
        let pool = SeatPool::new(None, None);
        let grace = Duration::from_millis(50);
        let (release, released) = mpsc::channel::<()>();
        let held = pool.take_seat(&owner(), None).expect("threads");
        held.handle().expect("it runs").spawn(async move { released.recv() });
        drop(held);
        std::thread::sleep(grace * 2);
        assert_eq!(pool.find_runaway(grace), None);
        std::thread::sleep(grace * 2);
        assert_eq!(pool.find_runaway(grace), None, "it waits");
        let culprit = Arc::new(StatementOwner::new("culprit".into(), Some(7)));
        culprit.set_statement("select 1");
        let held = pool.take_seat(&culprit, None).expect("threads");
        let (end, ended) = mpsc::channel::<()>();
        let task = held.handle().expect("it runs").spawn(async move {
            while ended.try_recv() == Err(mpsc::TryRecvError::Empty) {
                std::hint::spin_loop();
            }
        });
        drop(held);
        wait_until(|| pool.find_runaway(grace).is_some(), "it computes");
        let blame = pool.find_runaway(grace).expect("it still does");
        assert_eq!((blame.client.as_str(), blame.request), ("culprit", Some(7)));
        assert_eq!(blame.statement.as_deref(), Some("select 1"));
        drop(end);
        wait_until(|| task.is_finished(), "the task ends");
        wait_until(|| pool.find_runaway(grace).is_none(), "it is over");
        drop(release);
    }
}
