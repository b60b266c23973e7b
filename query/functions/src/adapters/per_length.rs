//! Cache of kernel plans for the lengths in the rows of one batch.

use std::collections::HashMap;

use datafusion::error::{DataFusionError, Result};

/// Maximum number of cached plans; the responses of a lake have one length.
const KEPT: usize = 8;
/// Maximum samples of a signal: over a second at 96 kHz, a whole sweep. A longer one would need memory that no limit of
/// queries counts.
const LONGEST: usize = 1 << 17;

/// Cache of plans with their buffers by length.
pub(crate) struct PerLength<P> {
    function: &'static str,
    plans: HashMap<usize, P>,
}

impl<P> PerLength<P> {
    pub fn new(function: &'static str) -> Self {
        Self { function, plans: HashMap::new() }
    }

    /// Returns the plan for a length.
    pub fn plan_for(
        &mut self,
        len: usize,
        make: impl FnOnce(usize) -> Result<P, echolake_dsp::Error>,
    ) -> Result<&mut P> {
        let name = self.function;
        if len > LONGEST {
            let hint = "array_slice() takes a part";
            let message = format!("`{name}`: a list has {len} samples, at most {LONGEST} are taken; hint: {hint}");
            return Err(DataFusionError::Execution(message));
        }
        if self.plans.len() >= KEPT && !self.plans.contains_key(&len) {
            self.plans.clear();
        }
        match self.plans.entry(len) {
            std::collections::hash_map::Entry::Occupied(plan) => Ok(plan.into_mut()),
            std::collections::hash_map::Entry::Vacant(place) => {
                let plan = make(len).map_err(|e| DataFusionError::Execution(format!("`{name}`: {e}")))?;
                Ok(place.insert(plan))
            }
        }
    }
}
