//! `shared_percentiles`: several percentiles and the median of the same values, for plans: no statement names it.
//!
//! DataFusion's `percentile_cont` collects all values again for each percentile, after the rows have been sorted, which
//! it does not need. Here its accumulator collects them once, in any order, and each group's values are partially
//! sorted once. The results have the same bits as those of `percentile_cont` and `median`.

use std::iter::repeat_n;
use std::sync::Arc;

use arrow::array::{
    Array as _, ArrayRef, ArrowNativeTypeOp, ArrowPrimitiveType, AsArray as _, BooleanArray, ListArray, PrimitiveArray,
    PrimitiveBuilder,
};
use arrow::buffer::OffsetBuffer;
use arrow::datatypes::{ArrowNativeType as _, DataType, Field, FieldRef, Float32Type, Float64Type};
use datafusion::error::{DataFusionError, Result};
use datafusion::functions_aggregate::percentile_cont::percentile_cont_udaf;
use datafusion::logical_expr::function::{AccumulatorArgs, StateFieldsArgs};
use datafusion::logical_expr::{
    Accumulator, AggregateUDF, AggregateUDFImpl, EmitTo, GroupsAccumulator, Signature, Volatility,
};
use datafusion::physical_expr::expressions::{Literal, lit};
use datafusion::scalar::ScalarValue;

/// `percentile_cont` rounds the weight of the upper of two values to so many steps.
const WEIGHT_STEPS: f64 = 1_000_000.0;

/// Returns `shared_percentiles(values, p, ...)`, a list of the percentiles: each `p` is from 0 to 1, or null for the
/// median.
pub fn shared_percentiles() -> AggregateUDF {
    AggregateUDF::new_from_impl(SharedPercentiles {
        collector: percentile_cont_udaf(),
        signature: Signature::variadic_any(Volatility::Immutable),
    })
}

#[derive(Debug, PartialEq, Eq, Hash)]
struct SharedPercentiles {
    /// Its accumulators collect the values.
    collector: Arc<AggregateUDF>,
    signature: Signature,
}

/// What is asked for of the values.
#[derive(Debug, Clone, Copy, PartialEq)]
enum WantedPercentile {
    /// Between the two values around this share of all.
    Interpolated(f64),
    /// The middle one, or the mean of both.
    Median,
}

/// The type of the values.
trait PercentileFloat: ArrowPrimitiveType {
    fn to_double(value: Self::Native) -> f64;
    fn from_double(value: f64) -> Self::Native;
}

impl PercentileFloat for Float32Type {
    fn to_double(value: f32) -> f64 {
        f64::from(value)
    }

    fn from_double(value: f64) -> f32 {
        value as f32
    }
}

impl PercentileFloat for Float64Type {
    fn to_double(value: f64) -> f64 {
        value
    }

    fn from_double(value: f64) -> f64 {
        value
    }
}

fn result_list(kind: &DataType) -> DataType {
    DataType::List(Arc::new(Field::new_list_field(kind.clone(), true)))
}

fn wanted_percentiles(args: &AccumulatorArgs<'_>) -> Result<Vec<WantedPercentile>> {
    let wanted = args.exprs.iter().skip(1).map(|expr| match expr.downcast_ref::<Literal>().map(Literal::value) {
        Some(ScalarValue::Float64(Some(share))) if (0.0..=1.0).contains(share) => {
            Some(WantedPercentile::Interpolated(*share))
        }
        Some(ScalarValue::Float64(None)) => Some(WantedPercentile::Median),
        _ => None,
    });
    let unknown = || DataFusionError::Plan("a percentile is a number from 0 to 1, or null".to_owned());
    wanted.collect::<Option<_>>().ok_or_else(unknown)
}

impl AggregateUDFImpl for SharedPercentiles {
    fn name(&self) -> &str {
        "shared_percentiles"
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        let none = || DataFusionError::Plan("shared_percentiles has no values".to_owned());
        types.first().map(result_list).ok_or_else(none)
    }

    fn state_fields(&self, args: StateFieldsArgs) -> Result<Vec<FieldRef>> {
        self.collector.state_fields(args)
    }

    fn accumulator(&self, args: AccumulatorArgs) -> Result<Box<dyn Accumulator>> {
        let wanted = wanted_percentiles(&args)?;
        let exprs = [args.exprs[0].clone(), lit(0.5)];
        let return_field = args.expr_fields[0].clone();
        let collector = self.collector.accumulator(AccumulatorArgs { exprs: &exprs, return_field, ..args })?;
        Ok(Box::new(PercentileValues { collector, wanted }))
    }

    fn groups_accumulator_supported(&self, _args: AccumulatorArgs) -> bool {
        true
    }

    fn create_groups_accumulator(&self, args: AccumulatorArgs) -> Result<Box<dyn GroupsAccumulator>> {
        let wanted = wanted_percentiles(&args)?;
        let exprs = [args.exprs[0].clone(), lit(0.5)];
        let return_field = args.expr_fields[0].clone();
        let args = AccumulatorArgs { exprs: &exprs, return_field, ..args };
        Ok(Box::new(PercentileGroups { collector: self.collector.create_groups_accumulator(args)?, wanted }))
    }
}

/// The values of all rows.
#[derive(Debug)]
struct PercentileValues {
    collector: Box<dyn Accumulator>,
    wanted: Vec<WantedPercentile>,
}

impl Accumulator for PercentileValues {
    fn update_batch(&mut self, values: &[ArrayRef]) -> Result<()> {
        self.collector.update_batch(&values[..1])
    }

    fn merge_batch(&mut self, states: &[ArrayRef]) -> Result<()> {
        self.collector.merge_batch(states)
    }

    fn state(&mut self) -> Result<Vec<ScalarValue>> {
        self.collector.state()
    }

    fn evaluate(&mut self) -> Result<ScalarValue> {
        match self.collector.state()?.as_slice() {
            [ScalarValue::List(values)] => Ok(ScalarValue::List(Arc::new(find_percentiles(values, &self.wanted)?))),
            _ => Err(other_state()),
        }
    }

    fn size(&self) -> usize {
        size_of::<Self>() + self.collector.size()
    }
}

/// The values of groups.
struct PercentileGroups {
    collector: Box<dyn GroupsAccumulator>,
    wanted: Vec<WantedPercentile>,
}

impl GroupsAccumulator for PercentileGroups {
    fn update_batch(
        &mut self,
        values: &[ArrayRef],
        groups: &[usize],
        filter: Option<&BooleanArray>,
        group_count: usize,
    ) -> Result<()> {
        self.collector.update_batch(&values[..1], groups, filter, group_count)
    }

    fn merge_batch(&mut self, states: &[ArrayRef], groups: &[usize], group_count: usize) -> Result<()> {
        self.collector.merge_batch(states, groups, group_count)
    }

    fn evaluate(&mut self, emit_to: EmitTo) -> Result<ArrayRef> {
        let state = self.collector.state(emit_to)?;
        let values = state.first().and_then(|values| values.as_list_opt::<i32>()).ok_or_else(other_state)?;
        Ok(Arc::new(find_percentiles(values, &self.wanted)?))
    }

    fn state(&mut self, emit_to: EmitTo) -> Result<Vec<ArrayRef>> {
        self.collector.state(emit_to)
    }

    fn convert_to_state(&self, values: &[ArrayRef], filter: Option<&BooleanArray>) -> Result<Vec<ArrayRef>> {
        self.collector.convert_to_state(&values[..1], filter)
    }

    fn size(&self) -> usize {
        size_of::<Self>() + self.collector.size()
    }
}

fn other_state() -> DataFusionError {
    DataFusionError::Internal("the state of `percentile_cont` is not a list of floats".to_owned())
}

/// Returns for each list of values one of what is wanted.
///
/// values  `[lists]` of floats, without nulls
/// result  `[lists][wanted]`; nulls for an empty list
fn find_percentiles(values: &ListArray, wanted: &[WantedPercentile]) -> Result<ListArray> {
    match values.value_type() {
        DataType::Float32 => Ok(percentile_lists::<Float32Type>(values, wanted)),
        DataType::Float64 => Ok(percentile_lists::<Float64Type>(values, wanted)),
        _ => Err(other_state()),
    }
}

fn percentile_lists<T: PercentileFloat>(lists: &ListArray, wanted: &[WantedPercentile]) -> ListArray {
    let mut values = lists.values().as_primitive::<T>().values().to_vec();
    let mut found = PrimitiveBuilder::<T>::with_capacity(lists.len() * wanted.len());
    let mut places = Vec::new();
    for bounds in lists.value_offsets().windows(2) {
        let group = &mut values[bounds[0].as_usize()..bounds[1].as_usize()];
        places.clear();
        places.extend(wanted.iter().flat_map(|percentile| percentile.places(group.len())));
        sort_places::<T>(group, &mut places);
        wanted.iter().for_each(|percentile| found.append_option(percentile.read_value::<T>(group)));
    }
    let found: PrimitiveArray<T> = found.finish();
    let offsets = OffsetBuffer::from_lengths(repeat_n(wanted.len(), lists.len()));
    ListArray::new(Arc::new(Field::new_list_field(T::DATA_TYPE, true)), offsets, Arc::new(found), None)
}

// Puts at these places what would be there if the values were sorted.
fn sort_places<T: PercentileFloat>(values: &mut [T::Native], places: &mut Vec<usize>) {
    places.sort_unstable();
    places.dedup();
    let mut start = 0;
    for place in places {
        // An empty group has no first place.
        if let Some(rest) = values.get_mut(start..).filter(|rest| !rest.is_empty()) {
            rest.select_nth_unstable_by(*place - start, |a, b| a.compare(*b));
        }
        start = *place + 1;
    }
}

impl WantedPercentile {
    // The places of the two values among sorted ones between which it is; mostly neighbours.
    fn places(self, count: usize) -> [usize; 2] {
        let last = count.saturating_sub(1);
        match self {
            Self::Interpolated(share) => {
                let place = share * last as f64;
                [(place.floor() as usize).min(last), (place.ceil() as usize).min(last)]
            }
            Self::Median => [last / 2, count / 2],
        }
    }

    // Of values that are in their places.
    fn read_value<T: PercentileFloat>(self, values: &[T::Native]) -> Option<T::Native> {
        let [lower, upper] = self.places(values.len());
        let low = *values.get(lower)?;
        let high = *values.get(upper)?;
        if lower == upper {
            return Some(low);
        }
        Some(match self {
            Self::Interpolated(share) => {
                let fraction = share * (values.len() - 1) as f64 - lower as f64;
                let weight = (fraction * WEIGHT_STEPS) as usize as f64 / WEIGHT_STEPS;
                let low = T::to_double(low);
                T::from_double(low + (T::to_double(high) - low) * weight)
            }
            Self::Median => low.add_wrapping(high).div_wrapping(T::Native::usize_as(2)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What sorting all values gives.
    fn sorted_percentile(values: &[f64], share: f64) -> Option<f64> {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let place = share * sorted.len().checked_sub(1)? as f64;
        let [low, high] = [place.floor(), place.ceil()].map(|place| sorted[place as usize]);
        Some(if low.to_bits() == high.to_bits() { low } else { low + (high - low) * place.fract() })
    }

    #[test]
    fn percentiles_are_those_of_sorted_values() {
        let shares = [0.95, 0.0, 0.5, 0.05, 1.0, 0.333];
        let wanted: Vec<_> =
            shares.map(WantedPercentile::Interpolated).into_iter().chain([WantedPercentile::Median]).collect();
        let values = |count: usize| (0..count).map(|i| ((i * 7919) % 1009) as f64 / 8.0 - 50.0).collect::<Vec<_>>();
        let groups: Vec<_> = [0, 1, 2, 3, 10, 1001, 0, 4].map(values).into();
        let lengths = groups.iter().map(Vec::len);
        let flat = Arc::new(PrimitiveArray::<Float64Type>::from(groups.concat()));
        let field = Arc::new(Field::new_list_field(DataType::Float64, true));
        let lists = ListArray::new(field, OffsetBuffer::from_lengths(lengths), flat, None);
        let found = find_percentiles(&lists, &wanted).expect("percentiles");
        for (place, group) in groups.iter().enumerate() {
            let row = found.value(place);
            let row = row.as_primitive::<Float64Type>();
            let expected = shares.map(|share| sorted_percentile(group, share)).into_iter();
            for (nth, expected) in expected.chain([sorted_percentile(group, 0.5)]).enumerate() {
                match expected {
                    Some(expected) => assert!((row.value(nth) - expected).abs() < 1e-3, "{place} {nth}: {row:?}"),
                    None => assert!(row.is_null(nth), "{place} {nth}: {row:?}"),
                }
            }
        }
    }
}
