//! Plans that another process runs, on the same lake with the same functions.
//!
//! `datafusion-distributed` encodes them with `datafusion-proto`. What does not cross the wire is not in them:
//!
//! - a scan's reader, which each process puts in by [`QueryEngine::rewrite_local_scans`];
//! - row selections of files, which are dropped without an error: a filter leaves out the same rows;
//! - the insides of functions: one is known by its name alone, because the crate's own codec stands before any other.
//!   So parameters are arguments, or follow from the types of arguments, and a process that decodes plans knows the
//!   functions of [`QueryEngine::worker_state`], beside those that statements name.

use std::sync::Arc;

use datafusion::common::tree_node::{TreeNode as _, TreeNodeRecursion};
use datafusion::error::{DataFusionError, Result};
use datafusion::execution::FunctionRegistry as _;
use datafusion::execution::TaskContext;
use datafusion::execution::session_state::SessionState;
use datafusion::physical_expr::ScalarFunctionExpr;
use datafusion::physical_plan::ExecutionPlan;
use datafusion_proto::bytes::physical_plan_to_bytes_with_extension_codec;
use datafusion_proto::physical_plan::{PhysicalExtensionCodec, PhysicalProtoConverterExtension};
use echolake_functions::shared_percentiles;
use echolake_mcap_tables::{McapFiles, decode_mcap_scan, encode_mcap_scan};

use crate::QueryEngine;

/// Encodes the scans of run files, and decodes them where their files can be read.
#[derive(Debug, Default)]
pub(crate) struct McapCodec {
    /// None in an engine, which sends scans and receives none.
    pub files: Option<Arc<McapFiles>>,
}

impl PhysicalExtensionCodec for McapCodec {
    fn try_decode(
        &self,
        bytes: &[u8],
        _: &[Arc<dyn ExecutionPlan>],
        _: &TaskContext,
        _: &dyn PhysicalProtoConverterExtension,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        let files = self.files.as_ref().ok_or_else(|| DataFusionError::Plan("scans are not read here".to_owned()))?;
        decode_mcap_scan(bytes, files)
    }

    fn try_encode(
        &self,
        node: Arc<dyn ExecutionPlan>,
        buffer: &mut Vec<u8>,
        _: &dyn PhysicalProtoConverterExtension,
    ) -> Result<()> {
        let scan = encode_mcap_scan(node.as_ref())?;
        let local = || DataFusionError::NotImplemented(format!("`{}` is not sent to workers", node.name()));
        buffer.extend(scan.ok_or_else(local)?);
        Ok(())
    }
}

impl QueryEngine {
    /// Returns the state in which plans of other processes are decoded: that of statements, with the functions that only
    /// plans have.
    pub fn worker_state(&self) -> SessionState {
        let mut state = self.template_state().clone();
        for function in self.catalog().plan_functions() {
            // Only a closed registry would refuse.
            let _ = state.register_udf(function);
        }
        let _ = state.register_udaf(Arc::new(shared_percentiles()));
        state
    }

    /// Replaces the scans of a plan by what this process holds of the files, just before it runs here: the last rewrite
    /// of a plan, after which it does not cross the wire.
    ///
    /// # Errors
    /// If a scan does not fit its table.
    pub fn rewrite_local_scans(&self, plan: Arc<dyn ExecutionPlan>) -> Result<Arc<dyn ExecutionPlan>> {
        self.catalog().rewrite_local_scans(plan)
    }
}

/// Checks that a plan can be run by another process, whose state is `worker` ([`QueryEngine::worker_state`]).
///
/// # Errors
/// [`DataFusionError::NotImplemented`] with the node or the function that only this process knows.
pub fn check_transport(plan: &Arc<dyn ExecutionPlan>, worker: &SessionState) -> Result<()> {
    plan.apply(|node| {
        node.apply_expressions(&mut |expr| {
            expr.apply(|part| {
                let function = part.downcast_ref::<ScalarFunctionExpr>().map(ScalarFunctionExpr::fun);
                match function.filter(|function| worker.udf(function.name()).is_err()) {
                    Some(own) => {
                        Err(DataFusionError::NotImplemented(format!("function {} of this session", own.name())))
                    }
                    None => Ok(TreeNodeRecursion::Continue),
                }
            })
        })?;
        Ok(TreeNodeRecursion::Continue)
    })?;
    match is_encoded(plan) {
        true => Ok(()),
        false => Err(DataFusionError::NotImplemented(format!("{} of this process", local_node(plan)))),
    }
}

fn is_encoded(plan: &Arc<dyn ExecutionPlan>) -> bool {
    physical_plan_to_bytes_with_extension_codec(plan.clone(), &McapCodec::default()).is_ok()
}

// The lowest node of a plan that is not encoded.
fn local_node(plan: &Arc<dyn ExecutionPlan>) -> &str {
    plan.children().into_iter().find(|child| !is_encoded(child)).map_or_else(|| plan.name(), local_node)
}
