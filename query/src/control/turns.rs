//! Turns to compute. Few statements compute at once, the others wait; turns go round by client, so that a client with
//! many statements delays another one's first by one turn at most.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::oneshot;

/// The turns of a process.
///
/// 1. At most `limit` statements have a turn.
/// 2. The last free turn is for a client that has none: no client holds all turns.
/// 3. Waiting clients are served in rotation, the statements of each in the order in which they came.
#[derive(Debug)]
pub(crate) struct TurnQueue(Mutex<QueueState>);

#[derive(Debug)]
struct QueueState {
    limit: usize,
    taken: usize,
    /// Clients with turns, and those that wait for some.
    clients: HashMap<Arc<str>, ClientTurns>,
    /// Clients that wait, the next one in front.
    rotation: VecDeque<Arc<str>>,
    next_number: u64,
}

#[derive(Debug, Default)]
struct ClientTurns {
    taken: usize,
    waiting: VecDeque<(u64, oneshot::Sender<ComputingTurn>)>,
}

/// A turn to compute, given back when it is dropped.
#[derive(Debug)]
pub(crate) struct ComputingTurn {
    queue: Arc<TurnQueue>,
    client: Arc<str>,
}

impl Drop for ComputingTurn {
    fn drop(&mut self) {
        self.queue.give_back(&self.client);
    }
}

/// A statement's place in the queue, which it leaves when this is dropped.
struct WaitingTurn {
    queue: Arc<TurnQueue>,
    client: Arc<str>,
    number: u64,
}

impl Drop for WaitingTurn {
    fn drop(&mut self) {
        self.queue.lock().leave_queue(&self.client, self.number);
    }
}

impl TurnQueue {
    /// Creates a queue for so many turns, one at least.
    pub fn new(limit: usize) -> Arc<Self> {
        let limit = limit.max(1);
        let state = QueueState { limit, taken: 0, clients: HashMap::new(), rotation: VecDeque::new(), next_number: 0 };
        Arc::new(Self(Mutex::new(state)))
    }

    /// Waits for a turn of this client. Dropping the future leaves the queue.
    pub async fn acquire_turn(self: &Arc<Self>, client: &Arc<str>) -> ComputingTurn {
        loop {
            let (place, granted) = {
                let mut state = self.lock();
                // Nobody who waits may have a turn now, see `grant_turns`.
                if state.may_take(client) {
                    state.count_turn(client);
                    return ComputingTurn { queue: self.clone(), client: client.clone() };
                }
                let (send, granted) = oneshot::channel();
                let number = state.join_queue(client, send);
                (WaitingTurn { queue: self.clone(), client: client.clone(), number }, granted)
            };
            let turn = granted.await;
            drop(place);
            if let Ok(turn) = turn {
                return turn;
            }
        }
    }

    fn give_back(self: &Arc<Self>, client: &Arc<str>) {
        let granted = {
            let mut state = self.lock();
            state.uncount_turn(client);
            state.grant_turns(self)
        };
        for (waiting, turn) in granted {
            // Whoever left meanwhile gives the turn back by dropping it, which locks the queue again.
            drop(waiting.send(turn));
        }
    }

    fn lock(&self) -> MutexGuard<'_, QueueState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl QueueState {
    fn may_take(&self, client: &Arc<str>) -> bool {
        let free = self.limit - self.taken;
        let has_turns = self.clients.get(client).is_some_and(|turns| turns.taken > 0);
        free > usize::from(has_turns)
    }

    fn count_turn(&mut self, client: &Arc<str>) {
        self.taken += 1;
        self.clients.entry(client.clone()).or_default().taken += 1;
    }

    fn uncount_turn(&mut self, client: &Arc<str>) {
        self.taken -= 1;
        if let Some(turns) = self.clients.get_mut(client) {
            turns.taken -= 1;
        }
        self.forget_idle(client);
    }

    fn join_queue(&mut self, client: &Arc<str>, send: oneshot::Sender<ComputingTurn>) -> u64 {
        let number = self.next_number;
        self.next_number += 1;
        let turns = self.clients.entry(client.clone()).or_default();
        if turns.waiting.is_empty() {
            self.rotation.push_back(client.clone());
        }
        turns.waiting.push_back((number, send));
        number
    }

    // It has left already if it was granted a turn.
    fn leave_queue(&mut self, client: &Arc<str>, number: u64) {
        let Some(turns) = self.clients.get_mut(client) else { return };
        let Some(at) = turns.waiting.iter().position(|(other, _)| *other == number) else { return };
        turns.waiting.remove(at);
        if turns.waiting.is_empty() {
            self.rotation.retain(|other| other != client);
        }
        self.forget_idle(client);
    }

    fn forget_idle(&mut self, client: &Arc<str>) {
        if self.clients.get(client).is_some_and(|turns| turns.taken == 0 && turns.waiting.is_empty()) {
            self.clients.remove(client);
        }
    }

    // Grants turns until nobody who waits may have one. They are sent without the lock.
    fn grant_turns(&mut self, queue: &Arc<TurnQueue>) -> Vec<(oneshot::Sender<ComputingTurn>, ComputingTurn)> {
        let mut granted = Vec::new();
        while let Some(at) = self.rotation.iter().position(|client| self.may_take(client)) {
            let Some(client) = self.rotation.remove(at) else { break };
            let Some(turns) = self.clients.get_mut(&client) else { continue };
            let Some((_, send)) = turns.waiting.pop_front() else { continue };
            if !turns.waiting.is_empty() {
                self.rotation.push_back(client.clone());
            }
            self.count_turn(&client);
            granted.push((send, ComputingTurn { queue: queue.clone(), client }));
        }
        granted
    }
}

#[cfg(test)]
mod tests {
    use std::task::Poll;

    use futures::future::BoxFuture;
    use futures::{FutureExt as _, poll};

    use super::*;

    type Waiting = BoxFuture<'static, ComputingTurn>;

    fn acquire(queue: &Arc<TurnQueue>, client: &str) -> Waiting {
        let (queue, client) = (queue.clone(), Arc::from(client));
        async move { queue.acquire_turn(&client).await }.boxed()
    }

    async fn granted(waiting: &mut Waiting) -> Option<ComputingTurn> {
        match poll!(waiting) {
            Poll::Ready(turn) => Some(turn),
            Poll::Pending => None,
        }
    }

    #[tokio::test]
    async fn one_client_never_has_all_turns_and_another_waits_for_none() {
        let queue = TurnQueue::new(3);
        let mut turns = Vec::new();
        for _ in 0..2 {
            turns.push(granted(&mut acquire(&queue, "many")).await.expect("free"));
        }
        let mut more: Vec<_> = (0..100).map(|_| acquire(&queue, "many")).collect();
        for waiting in &mut more {
            assert!(granted(waiting).await.is_none(), "the last turn is another's");
        }
        let first = granted(&mut acquire(&queue, "other")).await.expect("its first turn");
        let mut second = acquire(&queue, "other");
        assert!(granted(&mut second).await.is_none());
        let mut third = acquire(&queue, "third");
        assert!(granted(&mut third).await.is_none(), "all three are taken");
        turns.pop();
        let third = granted(&mut third).await.expect("the next turn, before a hundred others");
        assert!(granted(&mut more[0]).await.is_none());
        drop(third);
        assert!(granted(&mut more[0]).await.is_none(), "one turn is free, for a client that has none");
        drop(first);
        assert!(granted(&mut more[1]).await.is_none(), "each client's statements are in order");
        let again = (granted(&mut second).await, granted(&mut more[0]).await);
        assert!(again.0.is_some() && again.1.is_some(), "two turns were free");
    }

    #[tokio::test]
    async fn turns_go_round_by_client() {
        let queue = TurnQueue::new(1);
        let mut turn = granted(&mut acquire(&queue, "a")).await;
        let mut waiting = Vec::new();
        for client in ["a", "a", "b", "c", "a", "b"] {
            let mut place = acquire(&queue, client);
            assert!(granted(&mut place).await.is_none());
            waiting.push(place);
        }
        for next in [0, 2, 3, 1, 5, 4] {
            drop(turn.take());
            for (at, place) in waiting.iter_mut().enumerate().filter(|(at, _)| *at == next) {
                turn = granted(place).await;
                assert!(turn.is_some(), "{at} is next");
            }
        }
        drop(turn);
        assert!(queue.lock().clients.is_empty() && queue.lock().taken == 0, "nothing is left");
    }

    #[tokio::test]
    async fn who_leaves_the_queue_blocks_nobody() {
        let queue = TurnQueue::new(1);
        let turn = granted(&mut acquire(&queue, "a")).await.expect("free");
        let [mut left, mut granted_and_left, mut stays] = ["b", "c", "d"].map(|client| acquire(&queue, client));
        for waiting in [&mut left, &mut granted_and_left, &mut stays] {
            assert!(granted(waiting).await.is_none());
        }
        drop(left);
        drop(turn);
        // It was granted the turn, and never looks.
        drop(granted_and_left);
        let last = granted(&mut stays).await.expect("the turn went on");
        drop(last);
        assert!(queue.lock().clients.is_empty() && queue.lock().rotation.is_empty() && queue.lock().taken == 0);
    }
}
