//! A slice that is being cut, on the threads that encode answers. Dropping it ends the work.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use echolake_export::{Slice, SliceParams};
use echolake_lake::Snapshot;
use echolake_query::{EngineClient, Error as QueryError};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio::task::JoinSet;

use crate::fault::Fault;
use crate::metrics::Protocol;
use crate::running::{WAITING, finish};
use crate::service::Service;

/// How long a slice waits for its reader to take the next piece.
const PATIENCE: Duration = Duration::from_secs(300);

/// How long a slice waits for a place among what its client runs: work that was broken off gives its own back a moment
/// later.
const HANDOVER: Duration = Duration::from_secs(1);

/// A slice that is being cut.
pub(super) struct Cutting {
    pieces: mpsc::Receiver<Bytes>,
    task: JoinSet<Result<(), Fault>>,
}

/// What a slice takes up of the server.
pub(super) struct Room {
    pub(super) place: OwnedSemaphorePermit,
    /// Those who are worked at have one.
    pub(super) turns: Arc<Semaphore>,
}

impl Cutting {
    /// Begins, in one of its client's places.
    pub(super) fn begin(
        service: &Service,
        client: &Arc<EngineClient>,
        snapshot: Arc<Snapshot>,
        params: SliceParams,
        room: Room,
    ) -> Self {
        let (to, pieces) = mpsc::channel(WAITING);
        let (of, client) = (service.clone(), client.clone());
        let Room { place: room, turns } = room;
        let task = service.spawn(async move {
            let work = async {
                let _held = (client.place_within(HANDOVER).await?, room, of.metrics().begin(Protocol::Http));
                cut(&of, &snapshot, params, client.quota().time, &turns, to).await
            };
            work.await.inspect_err(|fault| of.metrics().failed(fault.code()))
        });
        Self { pieces, task }
    }

    /// The next bytes; None after the last.
    ///
    /// # Errors
    /// Why the slice cannot be cut, or not to its end.
    pub(super) async fn next(&mut self) -> Result<Option<Bytes>, Fault> {
        match self.pieces.recv().await {
            Some(piece) => Ok(Some(piece)),
            None => finish(&mut self.task).await.map(|()| None),
        }
    }
}

async fn cut(
    service: &Service,
    snapshot: &Snapshot,
    params: SliceParams,
    limit: Option<Duration>,
    turns: &Semaphore,
    to: mpsc::Sender<Bytes>,
) -> Result<(), Fault> {
    let mut begun = Instant::now();
    let mut worked = Duration::ZERO;
    let mut slice = Slice::open(service.lake(), snapshot, params).await?;
    let mut turn = None;
    while let Some(piece) = slice.next().await? {
        drop(turn.take());
        // The reader's time is not the server's.
        worked += begun.elapsed();
        if let Some(limit) = limit.filter(|limit| worked > *limit) {
            return Err(QueryError::TimeLimit { limit }.into());
        }
        // Nobody is there any more where sending fails.
        match tokio::time::timeout(PATIENCE, to.send(piece)).await {
            Ok(Ok(())) => {}
            _ => return Err(Fault::Cancelled),
        }
        // Never closed; a slice begins without a turn, so that its first bytes are early.
        turn = turns.acquire().await.ok();
        begun = Instant::now();
    }
    Ok(())
}
