//! A slice that is being cut, on the threads that encode answers. Dropping it ends the work.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use echolake_export::{Slice, SliceParams};
use echolake_lake::LakeSnapshot;
use echolake_query::{EngineClient, Error as QueryError};
use echolake_service::running::{WAITING, finish_task};
use echolake_service::{QueryService, RequestFault, StopSignal};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio::task::JoinSet;

use crate::request_protocol::request_protocol;

/// Time for which a slice waits for its reader to take the next piece.
const PATIENCE: Duration = Duration::from_secs(300);

/// Time for which a slice waits for a query permit of its client: cancelled work releases its own a moment later.
const HANDOVER: Duration = Duration::from_secs(1);
/// Its place among queries, in the stead of a statement.
const LISTED_AS: &str = "(a slice of run files)";

/// A slice that is being cut.
pub(super) struct SliceTask {
    pieces: mpsc::Receiver<Bytes>,
    task: JoinSet<Result<(), RequestFault>>,
}

/// Server resources that a slice occupies.
pub(super) struct SliceResources {
    pub place: OwnedSemaphorePermit,
    /// The permits of slices that are being worked on.
    pub turns: Arc<Semaphore>,
}

impl SliceTask {
    /// Begins, in one of its client's places.
    pub fn begin_cutting(
        service: &QueryService,
        client: &Arc<EngineClient>,
        snapshot: Arc<LakeSnapshot>,
        params: SliceParams,
        room: SliceResources,
    ) -> Self {
        let (to, pieces) = mpsc::channel(WAITING);
        let of = service.clone();
        let client = client.clone();
        let SliceResources { place: room, turns } = room;
        let protocol = request_protocol();
        let task = service.spawn_work(async move {
            let work = async {
                let stop = StopSignal::new();
                let timer = of.watch_query(protocol, LISTED_AS, &stop);
                let _held = (client.place_within(HANDOVER).await?, room);
                let done = tokio::select! {
                    done = cut_slice(&of, &snapshot, params, client.quota().time, &turns, to) => done,
                    () = stop.wait_for_stop() => Err(RequestFault::Cancelled),
                };
                timer.watch().record_outcome(done.as_ref().err());
                done
            };
            work.await.inspect_err(|fault| of.report_failure(fault.code()))
        });
        Self { pieces, task }
    }

    /// The next bytes; None after the last.
    ///
    /// # Errors
    /// Why the slice cannot be cut, or not to its end.
    pub async fn next(&mut self) -> Result<Option<Bytes>, RequestFault> {
        match self.pieces.recv().await {
            Some(piece) => Ok(Some(piece)),
            None => finish_task(&mut self.task).await.map(|()| None),
        }
    }
}

async fn cut_slice(
    service: &QueryService,
    snapshot: &LakeSnapshot,
    params: SliceParams,
    limit: Option<Duration>,
    turns: &Semaphore,
    to: mpsc::Sender<Bytes>,
) -> Result<(), RequestFault> {
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
        // If sending fails, the reader is gone.
        match tokio::time::timeout(PATIENCE, to.send(piece)).await {
            Ok(Ok(())) => {}
            _ => return Err(RequestFault::Cancelled),
        }
        // Never closed; a slice begins without a turn, so that its first bytes are early.
        turn = turns.acquire().await.ok();
        begun = Instant::now();
    }
    Ok(())
}
