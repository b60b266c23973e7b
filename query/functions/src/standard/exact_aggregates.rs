//! `sum`, `min` and `max` of DataFusion with PostgreSQL's answers: a sum of whole numbers is a decimal, which does not
//! wrap round, and NaN is above all other numbers, whether there are groups or not.
//!
//! DataFusion's own accumulators do the work, over other values: whole numbers as `decimal(38, 0)`; floats with one
//! NaN, or in groups as integers of the same order, because the accumulators of groups cannot compare a NaN.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::array::{ArrayRef, AsArray as _, BooleanArray, Decimal128Array, PrimitiveArray};
use arrow::datatypes::{DataType, Field, FieldRef, Float32Type, Float64Type, Int32Type, Int64Type, UInt64Type};
use datafusion::error::{DataFusionError, Result};
use datafusion::functions_aggregate::min_max::{max_udaf, min_udaf};
use datafusion::functions_aggregate::sum::sum_udaf;
use datafusion::logical_expr::function::{AccumulatorArgs, StateFieldsArgs};
use datafusion::logical_expr::utils::AggregateOrderSensitivity;
use datafusion::logical_expr::{
    Accumulator, AggregateUDF, AggregateUDFImpl, Documentation, EmitTo, GroupsAccumulator, ReversedUDAF,
    SetMonotonicity, Signature, StatisticsArgs,
};
use datafusion::scalar::ScalarValue;

use super::unified_floats::unify_nans;

/// Type of a sum of whole numbers: 2^63 rows of the greatest number are within it.
const WHOLE_SUM: DataType = DataType::Decimal128(38, 0);

/// Gives the values to an accumulator in another form, or takes its results back.
type ArrayMap = fn(&ArrayRef) -> Result<ArrayRef>;

/// An aggregate of DataFusion, and what is different here.
#[derive(Debug, PartialEq, Eq, Hash)]
struct ExactAggregate {
    own: Arc<AggregateUDF>,
    difference: AggregateDifference,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum AggregateDifference {
    /// Whole numbers are summed up as decimals.
    WholeSum,
    /// NaN is the greatest float.
    GreatestNan,
}

/// Returns `sum`, `min` and `max` for DataFusion.
pub fn exact_aggregates() -> [AggregateUDF; 3] {
    [
        (sum_udaf(), AggregateDifference::WholeSum),
        (min_udaf(), AggregateDifference::GreatestNan),
        (max_udaf(), AggregateDifference::GreatestNan),
    ]
    .map(|(own, difference)| AggregateUDF::new_from_impl(ExactAggregate { own, difference }))
}

impl ExactAggregate {
    /// Returns how the values reach an accumulator of one group whose result is of this type; None for as they are.
    fn value_map(&self, returned: &DataType) -> Option<ArrayMap> {
        match (self.difference, returned) {
            (AggregateDifference::WholeSum, returned) if *returned == WHOLE_SUM => Some(decimals_from_whole_numbers),
            (AggregateDifference::GreatestNan, DataType::Float32 | DataType::Float64) => {
                Some(|values| Ok(unify_nans(values)))
            }
            _ => None,
        }
    }

    fn map_accumulator(&self, returned: &DataType, inner: Box<dyn Accumulator>) -> Box<dyn Accumulator> {
        match self.value_map(returned) {
            Some(map) => Box::new(MappedAccumulator { inner, map }),
            None => inner,
        }
    }
}

impl AggregateUDFImpl for ExactAggregate {
    fn name(&self) -> &str {
        self.own.name()
    }

    fn aliases(&self) -> &[String] {
        self.own.aliases()
    }

    fn signature(&self) -> &Signature {
        self.own.signature()
    }

    fn coerce_types(&self, types: &[DataType]) -> Result<Vec<DataType>> {
        self.own.coerce_types(types)
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        let own = self.own.return_type(types)?;
        let is_whole_sum = self.difference == AggregateDifference::WholeSum && own.is_integer();
        Ok(if is_whole_sum { WHOLE_SUM } else { own })
    }

    fn state_fields(&self, args: StateFieldsArgs) -> Result<Vec<FieldRef>> {
        self.own.state_fields(args)
    }

    fn accumulator(&self, args: AccumulatorArgs) -> Result<Box<dyn Accumulator>> {
        let returned = args.return_type().clone();
        Ok(self.map_accumulator(&returned, self.own.accumulator(args)?))
    }

    fn create_sliding_accumulator(&self, args: AccumulatorArgs) -> Result<Box<dyn Accumulator>> {
        let returned = args.return_type().clone();
        if args.is_distinct && self.difference == AggregateDifference::WholeSum && returned == WHOLE_SUM {
            return Ok(self.map_accumulator(&returned, Box::new(DistinctWindowSum::default())));
        }
        Ok(self.map_accumulator(&returned, self.own.create_sliding_accumulator(args)?))
    }

    fn groups_accumulator_supported(&self, args: AccumulatorArgs) -> bool {
        self.own.groups_accumulator_supported(args)
    }

    fn create_groups_accumulator(&self, args: AccumulatorArgs) -> Result<Box<dyn GroupsAccumulator>> {
        let (keys, input, output): (_, ArrayMap, ArrayMap) = match (self.difference, args.return_type()) {
            (AggregateDifference::WholeSum, returned) if *returned == WHOLE_SUM => {
                (WHOLE_SUM, decimals_from_whole_numbers, |sums| Ok(sums.clone()))
            }
            (AggregateDifference::GreatestNan, DataType::Float32) => {
                (DataType::Int32, keys_from_floats, floats_from_keys)
            }
            (AggregateDifference::GreatestNan, DataType::Float64) => {
                (DataType::Int64, keys_from_floats, floats_from_keys)
            }
            _ => return self.own.create_groups_accumulator(args),
        };
        let return_field = Arc::new(Field::new(args.name, keys, true));
        let inner = self.own.create_groups_accumulator(AccumulatorArgs { return_field, ..args })?;
        Ok(Box::new(MappedGroups { inner, input, output }))
    }

    fn reverse_expr(&self) -> ReversedUDAF {
        ReversedUDAF::Identical
    }

    fn order_sensitivity(&self) -> AggregateOrderSensitivity {
        self.own.order_sensitivity()
    }

    fn is_descending(&self) -> Option<bool> {
        self.own.is_descending()
    }

    // The lake's tables have null for what is not finite, so that the bounds of a file are those of all its numbers.
    fn value_from_stats(&self, statistics: &StatisticsArgs) -> Option<ScalarValue> {
        match self.difference {
            AggregateDifference::WholeSum => None,
            AggregateDifference::GreatestNan => self.own.value_from_stats(statistics),
        }
    }

    fn set_monotonicity(&self, kind: &DataType) -> SetMonotonicity {
        self.own.inner().set_monotonicity(kind)
    }

    fn documentation(&self) -> Option<&Documentation> {
        self.own.documentation()
    }
}

/// An accumulator of DataFusion over mapped values.
#[derive(Debug)]
struct MappedAccumulator {
    inner: Box<dyn Accumulator>,
    map: ArrayMap,
}

impl MappedAccumulator {
    fn map_all(&self, values: &[ArrayRef]) -> Result<Vec<ArrayRef>> {
        values.iter().map(self.map).collect()
    }
}

impl Accumulator for MappedAccumulator {
    fn update_batch(&mut self, values: &[ArrayRef]) -> Result<()> {
        let values = self.map_all(values)?;
        self.inner.update_batch(&values)
    }

    fn merge_batch(&mut self, states: &[ArrayRef]) -> Result<()> {
        self.inner.merge_batch(states)
    }

    fn retract_batch(&mut self, values: &[ArrayRef]) -> Result<()> {
        let values = self.map_all(values)?;
        self.inner.retract_batch(&values)
    }

    fn supports_retract_batch(&self) -> bool {
        self.inner.supports_retract_batch()
    }

    fn state(&mut self) -> Result<Vec<ScalarValue>> {
        self.inner.state()
    }

    fn evaluate(&mut self) -> Result<ScalarValue> {
        self.inner.evaluate()
    }

    fn size(&self) -> usize {
        size_of::<Self>() + self.inner.size()
    }
}

/// An accumulator of groups of DataFusion over mapped values; its states and results are mapped back.
struct MappedGroups {
    inner: Box<dyn GroupsAccumulator>,
    input: ArrayMap,
    output: ArrayMap,
}

impl GroupsAccumulator for MappedGroups {
    fn update_batch(
        &mut self,
        values: &[ArrayRef],
        groups: &[usize],
        filter: Option<&BooleanArray>,
        group_count: usize,
    ) -> Result<()> {
        let values = values.iter().map(self.input).collect::<Result<Vec<_>>>()?;
        self.inner.update_batch(&values, groups, filter, group_count)
    }

    fn merge_batch(&mut self, states: &[ArrayRef], groups: &[usize], group_count: usize) -> Result<()> {
        let states = states.iter().map(self.input).collect::<Result<Vec<_>>>()?;
        self.inner.merge_batch(&states, groups, group_count)
    }

    fn evaluate(&mut self, emit_to: EmitTo) -> Result<ArrayRef> {
        (self.output)(&self.inner.evaluate(emit_to)?)
    }

    fn state(&mut self, emit_to: EmitTo) -> Result<Vec<ArrayRef>> {
        self.inner.state(emit_to)?.iter().map(self.output).collect()
    }

    fn convert_to_state(&self, values: &[ArrayRef], filter: Option<&BooleanArray>) -> Result<Vec<ArrayRef>> {
        let values = values.iter().map(self.input).collect::<Result<Vec<_>>>()?;
        self.inner.convert_to_state(&values, filter)?.iter().map(self.output).collect()
    }

    fn size(&self) -> usize {
        size_of::<Self>() + self.inner.size()
    }
}

/// Sum of the different decimals of a window that moves.
#[derive(Debug, Default)]
struct DistinctWindowSum {
    counts: HashMap<i128, u64>,
    sum: i128,
}

impl Accumulator for DistinctWindowSum {
    fn update_batch(&mut self, values: &[ArrayRef]) -> Result<()> {
        for value in values[0].as_primitive::<arrow::datatypes::Decimal128Type>().iter().flatten() {
            let count = self.counts.entry(value).or_default();
            if *count == 0 {
                self.sum += value;
            }
            *count += 1;
        }
        Ok(())
    }

    fn retract_batch(&mut self, values: &[ArrayRef]) -> Result<()> {
        for value in values[0].as_primitive::<arrow::datatypes::Decimal128Type>().iter().flatten() {
            let Some(count) = self.counts.get_mut(&value) else { continue };
            *count -= 1;
            if *count == 0 {
                self.counts.remove(&value);
                self.sum -= value;
            }
        }
        Ok(())
    }

    fn supports_retract_batch(&self) -> bool {
        true
    }

    fn merge_batch(&mut self, _states: &[ArrayRef]) -> Result<()> {
        Err(DataFusionError::NotImplemented("parts of a window's sum are not merged".to_owned()))
    }

    fn state(&mut self) -> Result<Vec<ScalarValue>> {
        Ok(vec![self.evaluate()?])
    }

    fn evaluate(&mut self) -> Result<ScalarValue> {
        Ok(ScalarValue::Decimal128((!self.counts.is_empty()).then_some(self.sum), 38, 0))
    }

    fn size(&self) -> usize {
        size_of::<Self>() + self.counts.capacity() * size_of::<(i128, u64)>()
    }
}

fn decimals_from_whole_numbers(values: &ArrayRef) -> Result<ArrayRef> {
    let decimals: Decimal128Array = match values.data_type() {
        DataType::Int64 => values.as_primitive::<Int64Type>().unary(i128::from),
        DataType::UInt64 => values.as_primitive::<UInt64Type>().unary(i128::from),
        _ => return Ok(values.clone()),
    };
    Ok(Arc::new(decimals.with_data_type(WHOLE_SUM)))
}

// The order of the integers is that of the floats: all bits but the sign of a negative float are turned round.
fn keys_from_floats(values: &ArrayRef) -> Result<ArrayRef> {
    let values = unify_nans(values);
    Ok(match values.data_type() {
        DataType::Float32 => {
            let keys: PrimitiveArray<Int32Type> =
                values.as_primitive::<Float32Type>().unary(|x| turn_bits_32(x.to_bits().cast_signed()));
            Arc::new(keys)
        }
        DataType::Float64 => {
            let keys: PrimitiveArray<Int64Type> =
                values.as_primitive::<Float64Type>().unary(|x| turn_bits_64(x.to_bits().cast_signed()));
            Arc::new(keys)
        }
        _ => values,
    })
}

fn floats_from_keys(keys: &ArrayRef) -> Result<ArrayRef> {
    Ok(match keys.data_type() {
        DataType::Int32 => {
            let floats: PrimitiveArray<Float32Type> =
                keys.as_primitive::<Int32Type>().unary(|key| f32::from_bits(turn_bits_32(key).cast_unsigned()));
            Arc::new(floats)
        }
        DataType::Int64 => {
            let floats: PrimitiveArray<Float64Type> =
                keys.as_primitive::<Int64Type>().unary(|key| f64::from_bits(turn_bits_64(key).cast_unsigned()));
            Arc::new(floats)
        }
        _ => keys.clone(),
    })
}

fn turn_bits_32(bits: i32) -> i32 {
    bits ^ ((bits >> 31) & i32::MAX)
}

fn turn_bits_64(bits: i64) -> i64 {
    bits ^ ((bits >> 63) & i64::MAX)
}

#[cfg(test)]
mod tests {
    use arrow::array::Float64Array;

    use super::*;

    /// W5: The keys of floats have the order that `max` has, with any NaN above all.
    #[test]
    fn keys_have_the_order_of_floats() {
        let floats = [f64::NEG_INFINITY, f64::MIN, -1.5, -0.0, 0.0, f64::MIN_POSITIVE, 2.0, f64::INFINITY, -f64::NAN];
        let values: ArrayRef = Arc::new(Float64Array::from(floats.to_vec()));
        let keys = keys_from_floats(&values).expect("keys");
        assert!(keys.as_primitive::<Int64Type>().values().is_sorted());
        let back = floats_from_keys(&keys).expect("floats");
        let back = back.as_primitive::<Float64Type>().values();
        assert_eq!(back[..8], floats[..8]);
        assert!(back[8].is_nan());
    }
}
