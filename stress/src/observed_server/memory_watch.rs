//! Samples the memory of a server's processes, and kills them before they take what others on the machine need.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use super::ProcessTree;
use super::repeated_work::RepeatedWork;

/// Between two samples.
const SAMPLE_EVERY: Duration = Duration::from_millis(50);
/// Processes that take more together are killed.
const MEMORY_CAP_MIB: u64 = 6 << 10;

/// The most that was in memory, MiB.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct MemoryPeak {
    pub door_mib: u64,
    pub total_mib: u64,
    /// True if the processes were killed because they took too much.
    pub is_capped: bool,
}

/// Samples until it is dropped.
pub(crate) struct MemoryWatch {
    peak: Arc<Mutex<MemoryPeak>>,
    _sampler: RepeatedWork,
}

impl MemoryWatch {
    pub fn start(tree: ProcessTree) -> Self {
        let peak = Arc::<Mutex<MemoryPeak>>::default();
        let sampled = peak.clone();
        let _sampler = RepeatedWork::start(SAMPLE_EVERY, move || take_sample(tree, &sampled));
        Self { peak, _sampler }
    }

    /// Returns the peak so far.
    pub fn peak(&self) -> MemoryPeak {
        *self.peak.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn take_sample(tree: ProcessTree, peak: &Mutex<MemoryPeak>) {
    let memory = tree.memory();
    let mut peak = peak.lock().unwrap_or_else(PoisonError::into_inner);
    peak.door_mib = peak.door_mib.max(memory.door_kib >> 10);
    peak.total_mib = peak.total_mib.max(memory.total_kib >> 10);
    if memory.total_kib >> 10 > MEMORY_CAP_MIB {
        peak.is_capped = true;
        tree.kill();
    }
}
