//! Limits of DataFusion's functions over many rows, for processes whose memory is limited: in a window, `array_agg`,
//! `string_agg` and `last_value` compute or copy a whole frame for each row, so that they ask for each row whether the
//! statement goes on; a text of `string_agg` is doubled before the memory pool counts it, so that it has a maximum.

use std::ops::Range;
use std::sync::Arc;

use arrow::array::{ArrayRef, BooleanArray};
use arrow::datatypes::{DataType, FieldRef};
use datafusion::error::{DataFusionError, Result};
use datafusion::functions_aggregate::array_agg::array_agg_udaf;
use datafusion::functions_aggregate::string_agg::string_agg_udaf;
use datafusion::functions_window::nth_value::{first_value_udwf, last_value_udwf, nth_value_udwf};
use datafusion::logical_expr::function::{
    AccumulatorArgs, ExpressionArgs, PartitionEvaluatorArgs, StateFieldsArgs, WindowUDFFieldArgs,
};
use datafusion::logical_expr::utils::AggregateOrderSensitivity;
use datafusion::logical_expr::window_state::WindowAggState;
use datafusion::logical_expr::{
    Accumulator, AggregateUDF, AggregateUDFImpl, Documentation, EmitTo, GroupsAccumulator, LimitEffect,
    PartitionEvaluator, ReversedUDAF, ReversedUDWF, Signature, WindowUDF, WindowUDFImpl,
};
use datafusion::physical_expr::PhysicalExpr;
use datafusion::scalar::ScalarValue;

use super::call_size::value_bytes;
use super::call_stop::check_stop;

/// Bytes of the texts that one `string_agg` may hold.
const MOST_TEXT_BYTES: usize = 256 << 20;
/// Bytes from which on a result is a large one.
const LARGE_RESULT: usize = 16 << 10;
/// Bytes of the large results of one window, which holds them until its rows are given out.
const MOST_RESULT_BYTES: usize = 128 << 20;

/// Returns `array_agg` and `string_agg` with their limits.
pub fn limited_aggregates() -> [AggregateUDF; 2] {
    [(array_agg_udaf(), None), (string_agg_udaf(), Some(MOST_TEXT_BYTES))]
        .map(|(own, most_bytes)| AggregateUDF::new_from_impl(LimitedAggregate { own, most_bytes }))
}

/// Returns `first_value`, `last_value` and `nth_value`, which end with their statement.
pub fn limited_windows() -> [WindowUDF; 3] {
    [first_value_udwf(), last_value_udwf(), nth_value_udwf()].map(|own| WindowUDF::new_from_impl(LimitedWindow { own }))
}

/// An aggregate of DataFusion with a limit.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct LimitedAggregate {
    own: Arc<AggregateUDF>,
    /// Bytes of texts that an accumulator may hold.
    most_bytes: Option<usize>,
}

impl LimitedAggregate {
    fn with_own(&self, own: Arc<AggregateUDF>) -> Self {
        Self { own, most_bytes: self.most_bytes }
    }

    fn limit_accumulator(&self, inner: Box<dyn Accumulator>) -> Box<dyn Accumulator> {
        Box::new(LimitedAccumulator { inner, limit: self.clone(), large_results: None })
    }

    // An accumulator of lists adds up its size from all of its values, so that it is not called without a maximum.
    fn check_values(&self, held_bytes: impl FnOnce() -> usize, values: &[ArrayRef]) -> Result<()> {
        check_stop()?;
        let Some(most_bytes) = self.most_bytes else { return Ok(()) };
        let added = values.first().map_or(0.0, value_bytes) as usize;
        match held_bytes().saturating_add(added) <= most_bytes {
            true => Ok(()),
            false => Err(DataFusionError::Execution(format!(
                "{} would hold more than {} MiB of texts; hint: fewer or shorter texts, or array_agg",
                self.own.name(),
                most_bytes >> 20
            ))),
        }
    }
}

impl AggregateUDFImpl for LimitedAggregate {
    fn name(&self) -> &str {
        self.own.name()
    }

    fn aliases(&self) -> &[String] {
        self.own.aliases()
    }

    fn signature(&self) -> &Signature {
        self.own.signature()
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        self.own.return_type(types)
    }

    fn return_field(&self, fields: &[FieldRef]) -> Result<FieldRef> {
        self.own.return_field(fields)
    }

    fn state_fields(&self, args: StateFieldsArgs) -> Result<Vec<FieldRef>> {
        self.own.state_fields(args)
    }

    fn accumulator(&self, args: AccumulatorArgs) -> Result<Box<dyn Accumulator>> {
        Ok(self.limit_accumulator(self.own.accumulator(args)?))
    }

    fn create_sliding_accumulator(&self, args: AccumulatorArgs) -> Result<Box<dyn Accumulator>> {
        Ok(self.limit_accumulator(self.own.create_sliding_accumulator(args)?))
    }

    fn groups_accumulator_supported(&self, args: AccumulatorArgs) -> bool {
        self.own.groups_accumulator_supported(args)
    }

    fn create_groups_accumulator(&self, args: AccumulatorArgs) -> Result<Box<dyn GroupsAccumulator>> {
        let inner = self.own.create_groups_accumulator(args)?;
        Ok(Box::new(LimitedGroups { inner, limit: self.clone() }))
    }

    fn with_beneficial_ordering(self: Arc<Self>, is_ordered: bool) -> Result<Option<Arc<dyn AggregateUDFImpl>>> {
        let ordered = self.own.as_ref().clone().with_beneficial_ordering(is_ordered)?;
        Ok(ordered.map(|own| Arc::new(self.with_own(Arc::new(own))) as Arc<dyn AggregateUDFImpl>))
    }

    fn order_sensitivity(&self) -> AggregateOrderSensitivity {
        self.own.order_sensitivity()
    }

    fn reverse_expr(&self) -> ReversedUDAF {
        match self.own.reverse_udf() {
            ReversedUDAF::Reversed(own) => {
                ReversedUDAF::Reversed(Arc::new(AggregateUDF::new_from_impl(self.with_own(own))))
            }
            same => same,
        }
    }

    fn supports_null_handling_clause(&self) -> bool {
        self.own.supports_null_handling_clause()
    }

    fn documentation(&self) -> Option<&Documentation> {
        self.own.documentation()
    }
}

/// An accumulator that ends with its statement.
#[derive(Debug)]
struct LimitedAccumulator {
    inner: Box<dyn Accumulator>,
    limit: LimitedAggregate,
    /// Bytes of its large results; None before the first result, which is the only one outside of windows.
    large_results: Option<usize>,
}

impl LimitedAccumulator {
    fn count_result(&mut self, result: &ScalarValue) -> Result<()> {
        let bytes = result.size();
        let Some(before) = self.large_results else {
            self.large_results = Some(0);
            return Ok(());
        };
        let total = before.saturating_add(if bytes < LARGE_RESULT { 0 } else { bytes });
        self.large_results = Some(total);
        match total <= MOST_RESULT_BYTES {
            true => Ok(()),
            false => Err(DataFusionError::Execution(format!(
                "the results of {} over a window have more than {} MiB; hint: a frame of fewer rows",
                self.limit.own.name(),
                MOST_RESULT_BYTES >> 20
            ))),
        }
    }
}

impl Accumulator for LimitedAccumulator {
    fn update_batch(&mut self, values: &[ArrayRef]) -> Result<()> {
        self.limit.check_values(|| self.inner.size(), values)?;
        self.inner.update_batch(values)
    }

    fn merge_batch(&mut self, states: &[ArrayRef]) -> Result<()> {
        self.limit.check_values(|| self.inner.size(), states)?;
        self.inner.merge_batch(states)
    }

    fn retract_batch(&mut self, values: &[ArrayRef]) -> Result<()> {
        check_stop()?;
        self.inner.retract_batch(values)
    }

    fn supports_retract_batch(&self) -> bool {
        self.inner.supports_retract_batch()
    }

    fn state(&mut self) -> Result<Vec<ScalarValue>> {
        self.inner.state()
    }

    fn evaluate(&mut self) -> Result<ScalarValue> {
        check_stop()?;
        let result = self.inner.evaluate()?;
        self.count_result(&result)?;
        Ok(result)
    }

    fn size(&self) -> usize {
        size_of::<Self>() + self.inner.size()
    }
}

/// An accumulator of groups that ends with its statement.
struct LimitedGroups {
    inner: Box<dyn GroupsAccumulator>,
    limit: LimitedAggregate,
}

impl GroupsAccumulator for LimitedGroups {
    fn update_batch(
        &mut self,
        values: &[ArrayRef],
        groups: &[usize],
        filter: Option<&BooleanArray>,
        group_count: usize,
    ) -> Result<()> {
        self.limit.check_values(|| self.inner.size(), values)?;
        self.inner.update_batch(values, groups, filter, group_count)
    }

    fn merge_batch(&mut self, states: &[ArrayRef], groups: &[usize], group_count: usize) -> Result<()> {
        self.limit.check_values(|| self.inner.size(), states)?;
        self.inner.merge_batch(states, groups, group_count)
    }

    fn evaluate(&mut self, emit_to: EmitTo) -> Result<ArrayRef> {
        check_stop()?;
        self.inner.evaluate(emit_to)
    }

    fn state(&mut self, emit_to: EmitTo) -> Result<Vec<ArrayRef>> {
        self.inner.state(emit_to)
    }

    fn convert_to_state(&self, values: &[ArrayRef], filter: Option<&BooleanArray>) -> Result<Vec<ArrayRef>> {
        self.inner.convert_to_state(values, filter)
    }

    fn size(&self) -> usize {
        size_of::<Self>() + self.inner.size()
    }
}

/// A function of windows that ends with its statement.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct LimitedWindow {
    own: Arc<WindowUDF>,
}

impl WindowUDFImpl for LimitedWindow {
    fn name(&self) -> &str {
        self.own.name()
    }

    fn aliases(&self) -> &[String] {
        self.own.aliases()
    }

    fn signature(&self) -> &Signature {
        self.own.signature()
    }

    fn expressions(&self, args: ExpressionArgs) -> Vec<Arc<dyn PhysicalExpr>> {
        self.own.expressions(args)
    }

    fn partition_evaluator(&self, args: PartitionEvaluatorArgs) -> Result<Box<dyn PartitionEvaluator>> {
        Ok(Box::new(LimitedEvaluator(self.own.partition_evaluator_factory(args)?)))
    }

    fn field(&self, args: WindowUDFFieldArgs) -> Result<FieldRef> {
        self.own.field(args)
    }

    fn reverse_expr(&self) -> ReversedUDWF {
        match self.own.reverse_expr() {
            ReversedUDWF::Reversed(own) => ReversedUDWF::Reversed(Arc::new(WindowUDF::new_from_impl(Self { own }))),
            same => same,
        }
    }

    fn documentation(&self) -> Option<&Documentation> {
        self.own.documentation()
    }

    fn limit_effect(&self, args: &[Arc<dyn PhysicalExpr>]) -> LimitEffect {
        self.own.inner().limit_effect(args)
    }
}

/// Computes a partition of a window, one row after the other.
#[derive(Debug)]
struct LimitedEvaluator(Box<dyn PartitionEvaluator>);

impl PartitionEvaluator for LimitedEvaluator {
    fn memoize(&mut self, state: &mut WindowAggState) -> Result<()> {
        self.0.memoize(state)
    }

    fn get_range(&self, row: usize, rows: usize) -> Result<Range<usize>> {
        self.0.get_range(row, rows)
    }

    fn is_causal(&self) -> bool {
        self.0.is_causal()
    }

    fn evaluate_all(&mut self, values: &[ArrayRef], rows: usize) -> Result<ArrayRef> {
        check_stop()?;
        self.0.evaluate_all(values, rows)
    }

    fn evaluate(&mut self, values: &[ArrayRef], range: &Range<usize>) -> Result<ScalarValue> {
        check_stop()?;
        self.0.evaluate(values, range)
    }

    fn supports_bounded_execution(&self) -> bool {
        self.0.supports_bounded_execution()
    }

    fn uses_window_frame(&self) -> bool {
        self.0.uses_window_frame()
    }
}
