//! Limits of queries: a [`QueryTicket`] signals whether a query may continue, [`pool`] counts the memory of its
//! operators, [`turns`] says when it may compute, [`seats`] gives it threads.
//!
//! DataFusion ends a query only at an await, and allocates between two checks of its pool.
//! [`RunningQueries::find_runaway`] finds work that goes on computing after its query has ended; a server then ends the
//! whole process.

pub(crate) mod blame;
pub(crate) mod pool;
pub(crate) mod seats;
mod thread_clock;
pub(crate) mod threads;
pub(crate) mod turns;

use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError, Weak};
use std::time::Duration;

use futures::future::Either;
use tokio::runtime::Handle;
use tokio::sync::Notify;
use tokio::task::AbortHandle;

use blame::{StatementBlame, StatementOwner};
use pool::HeldMemory;
use seats::{HeldSeat, SeatPool};
use turns::{ComputingTurn, TurnQueue};

tokio::task_local! {
    /// The work that the current task is part of. Queries that it begins compute in its turn, on its seat.
    static OUTER_WORK: Arc<QueryTicket>;
}

/// Makes `work`, which is to run as a task of its own, part of the current request: while a request waits for a query of
/// its own, that query computes in the request's turn. Otherwise requests with all turns could wait for each other's
/// queries, which have none.
pub fn continue_request<F: Future>(work: F) -> impl Future<Output = F::Output> {
    match QueryTicket::current_work() {
        Some(outer) => Either::Left(OUTER_WORK.scope(outer, work)),
        None => Either::Right(work),
    }
}

/// Reason for which a query was stopped.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum StopReason {
    /// The client cancelled it.
    Cancelled,
    /// It took too long.
    Time(Duration),
    /// The process has no memory left, and this query holds the most.
    Memory,
}

/// Cancellation state, turn, seat and accounting of one query.
pub(crate) struct QueryTicket {
    owner: Arc<StatementOwner>,
    stop: OnceLock<StopReason>,
    stopped: Notify,
    /// Bytes that its operators have reserved.
    held: Arc<HeldMemory>,
    /// Its seat is one of the program's own.
    pub is_program: bool,
    place: Mutex<ComputingPlace>,
    /// The work that waits for this query, in whose turn and on whose seat it computes.
    outer: Option<Arc<QueryTicket>>,
    /// The task that stops the query at its timeout; it ends with the ticket.
    timer: OnceLock<AbortHandle>,
}

/// What a query needs to compute. The turn is given back first: it is free once the ticket is gone.
#[derive(Debug, Default)]
struct ComputingPlace {
    turn: Option<ComputingTurn>,
    seat: Option<Arc<HeldSeat>>,
}

impl Drop for QueryTicket {
    fn drop(&mut self) {
        if let Some(timer) = self.timer.get() {
            timer.abort();
        }
    }
}

impl QueryTicket {
    /// Creates the ticket of a query, which is part of the work of the current task, if that is some.
    pub fn new(client: Arc<str>, request: Option<u64>, is_program: bool) -> Self {
        Self {
            owner: Arc::new(StatementOwner::new(client, request)),
            stop: OnceLock::new(),
            stopped: Notify::new(),
            held: Arc::default(),
            is_program,
            place: Mutex::default(),
            outer: Self::current_work().filter(|outer| outer.seat_handle().is_some()),
            timer: OnceLock::new(),
        }
    }

    fn current_work() -> Option<Arc<Self>> {
        OUTER_WORK.try_with(Arc::clone).ok()
    }

    /// Makes the ticket's query the one that the queries of `work` are part of.
    pub fn scope_work<F: Future>(self: &Arc<Self>, work: F) -> impl Future<Output = F::Output> + use<F> {
        OUTER_WORK.scope(self.clone(), work)
    }

    /// Sets the task that stops the query at its timeout.
    pub fn set_timer(&self, timer: AbortHandle) {
        let _ = self.timer.set(timer);
    }

    /// Sets the statement's text, once.
    pub fn set_statement(&self, sql: &str) {
        self.owner.set_statement(sql);
    }

    /// Stops the query; the first reason counts. The seat of another one, in whose turn it computes, is not stopped.
    pub fn stop(&self, why: StopReason) {
        let _ = self.stop.set(why);
        if let Some(seat) = &self.lock_place().seat {
            seat.stop_calls();
        }
        self.stopped.notify_waiters();
    }

    /// Returns the reason for which the query was stopped, if it was.
    pub fn stop_reason(&self) -> Option<&StopReason> {
        self.stop.get()
    }

    /// Waits until the query must end.
    pub async fn wait_for_stop(&self) -> StopReason {
        loop {
            // Subscribes before the check, or a stop between them would be missed.
            let stopped = self.stopped.notified();
            if let Some(why) = self.stop_reason() {
                return why.clone();
            }
            stopped.await;
        }
    }

    /// Bytes that its operators have reserved.
    pub fn held_memory(&self) -> &Arc<HeldMemory> {
        &self.held
    }

    /// Waits for a turn and takes a seat, unless the query has them; returns the seat's threads, None during shutdown.
    ///
    /// # Errors
    /// If the system cannot start threads.
    pub async fn begin_computing(
        &self,
        turns: &Arc<TurnQueue>,
        seats: &Arc<SeatPool>,
    ) -> std::io::Result<Option<Handle>> {
        if let Some(outer) = &self.outer
            && let Some(threads) = outer.seat_handle()
        {
            return Ok(Some(threads));
        }
        // Whoever waits for a turn may have a seat, so whoever has a turn must not wait for one.
        let has_seat = self.lock_place().seat.is_some();
        let seat_place = if has_seat { None } else { seats.wait_for_place().await };
        self.resume_computing(turns).await;
        let mut place = self.lock_place();
        let seat = match &place.seat {
            Some(seat) => seat.clone(),
            None => Arc::new(seats.take_seat(&self.owner, seat_place)?),
        };
        place.seat = Some(seat.clone());
        Ok(seat.handle().cloned())
    }

    /// Gives the turn back, for as long as the query's reader fetches nothing. A query in another one's turn has none.
    pub fn pause_computing(&self) {
        // Whoever gets the turn is notified without the lock.
        let turn = self.lock_place().turn.take();
        drop(turn);
    }

    /// Waits for a turn, unless the query has one, or computes in another one's.
    pub async fn resume_computing(&self, turns: &Arc<TurnQueue>) {
        let has_turn = self.outer.is_some() || self.lock_place().turn.is_some();
        if !has_turn {
            let turn = turns.acquire_turn(&self.owner.client).await;
            self.lock_place().turn = Some(turn);
        }
    }

    /// Gives turn and seat back.
    pub fn end_computing(&self) {
        let place = std::mem::take(&mut *self.lock_place());
        drop(place);
    }

    fn seat_handle(&self) -> Option<Handle> {
        match &self.outer {
            Some(outer) => outer.seat_handle(),
            None => self.lock_place().seat.as_ref()?.handle().cloned(),
        }
    }

    fn lock_place(&self) -> MutexGuard<'_, ComputingPlace> {
        self.place.lock().unwrap_or_else(PoisonError::into_inner)
    }

    // A query on another one's seat is blamed on that one.
    fn find_blame(&self, grace: Duration) -> Option<StatementBlame> {
        self.stop_reason()?;
        let seat = self.lock_place().seat.clone()?;
        seat.find_blame(grace)
    }
}

impl fmt::Debug for QueryTicket {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("QueryTicket")
            .field("owner", &self.owner)
            .field("stop", &self.stop_reason())
            .field("held", &self.held)
            .finish_non_exhaustive()
    }
}

/// The queries of a process.
#[derive(Debug, Default)]
pub(crate) struct RunningQueries(Mutex<Vec<Weak<QueryTicket>>>);

impl RunningQueries {
    pub fn add_ticket(&self, ticket: &Arc<QueryTicket>) {
        let mut tickets = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        tickets.retain(|t| t.strong_count() > 0);
        tickets.push(Arc::downgrade(ticket));
    }

    /// Counts the queries that run or wait.
    pub fn count_running(&self) -> usize {
        self.running_tickets().count()
    }

    /// Returns a query that was ended, and on whose seat a thread has computed for more than `grace` since the first
    /// such look.
    pub fn find_runaway(&self, grace: Duration) -> Option<StatementBlame> {
        self.live_tickets().iter().find_map(|ticket| ticket.find_blame(grace))
    }

    /// Stops the query that holds the most memory, and returns whose it was; None if no query holds any.
    pub fn cancel_largest(&self) -> Option<StatementBlame> {
        let largest = self.running_tickets().max_by_key(|ticket| ticket.held.current_bytes())?;
        if largest.held.current_bytes() == 0 {
            return None;
        }
        largest.stop(StopReason::Memory);
        Some(largest.owner.blame())
    }

    /// Cancels all queries of the clients of this name.
    pub fn cancel_client(&self, name: &str) {
        self.running_tickets().filter(|ticket| *ticket.owner.client == *name).for_each(|ticket| {
            ticket.stop(StopReason::Cancelled);
        });
    }

    fn running_tickets(&self) -> impl Iterator<Item = Arc<QueryTicket>> {
        self.live_tickets().into_iter().filter(|ticket| ticket.stop_reason().is_none())
    }

    fn live_tickets(&self) -> Vec<Arc<QueryTicket>> {
        let tickets = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        tickets.iter().filter_map(Weak::upgrade).collect()
    }
}
