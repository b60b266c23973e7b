//! `avg_list`: the mean of many lists, element by element.

use std::sync::Arc;

use arrow::array::{ArrayRef, AsArray as _, UInt64Array};
use arrow::buffer::NullBuffer;
use arrow::datatypes::{DataType, Float64Type, UInt64Type};
use datafusion::error::{DataFusionError, Result};
use echolake_dsp::mean::SignalMean;

use crate::adapters::aggregate::{AggregateKernel, GroupStates};
use crate::adapters::answers::list_array;
use crate::adapters::arguments::{CallArguments, SampleElement, element_type, list_of, same_list_type};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};

/// `avg_list`.
#[derive(Clone)]
pub(crate) struct AvgListFunction;

static DESCRIPTION: FunctionDescription = FunctionDescription {
    name: "avg_list",
    family: FunctionFamily::Aggregates,
    about: "Mean of equally long lists, element by element, in their unit: of the responses of repeated runs, what a \
            reference is. Summed up in f64. Null lists do not count; null of none.",
    parameters: &[FunctionParameter { name: "list", kind: ArgumentKind::Samples, about: "the lists, as ir" }],
    optional: 0,
    example: "select avg_list(x) as mean from (values ([1, 2]), ([3, 6])) as t(x)",
    answer: "\
+------------+
| mean       |
+------------+
| [2.0, 4.0] |
+------------+",
    related: &["list_energy", "pearson"],
};

impl AvgListFunction {
    fn add_lists<T: SampleElement>(arguments: &CallArguments<'_>, groups: &mut GroupStates<'_, Self>) -> Result<()> {
        let lists = arguments.sample_lists::<T>(0)?;
        for row in (0..arguments.row_count()).filter(|row| !arguments.is_null(*row)) {
            let list = lists.samples_at(row)?;
            groups.update_at(row, |group| group.add_signal(list).map_err(|e| arguments.refused_row(row, &e)))?;
        }
        Ok(())
    }

    fn mean_lists<T: SampleElement>(groups: &[SignalMean]) -> Result<ArrayRef> {
        let mut values = Vec::new();
        groups.iter().for_each(|group| values.extend(group.mean_values().map(T::of)));
        let nulls = NullBuffer::from_iter(groups.iter().map(|group| group.count() > 0));
        Ok(Arc::new(list_array::<T>(values, list_offsets(groups)?, Some(nulls))?))
    }
}

impl AggregateKernel for AvgListFunction {
    type Group = SignalMean;

    fn description(&self) -> &'static FunctionDescription {
        &DESCRIPTION
    }

    fn answer_type(&self, arguments: &[DataType]) -> DataType {
        same_list_type(&arguments[0])
    }

    fn state_columns(&self) -> Vec<(&'static str, DataType)> {
        vec![("sums", list_of(DataType::Float64)), ("count", DataType::UInt64)]
    }

    fn update_groups(&self, arguments: &CallArguments<'_>, groups: &mut GroupStates<'_, Self>) -> Result<()> {
        match arguments.sample_lists::<f32>(0) {
            Ok(_) => Self::add_lists::<f32>(arguments, groups),
            Err(_) => Self::add_lists::<f64>(arguments, groups),
        }
    }

    fn merge_states(&self, states: &[ArrayRef], groups: &mut GroupStates<'_, Self>) -> Result<()> {
        let lists = states[0].as_list::<i32>();
        let counts = states[1].as_primitive::<UInt64Type>().values();
        let sums = lists.values().as_primitive::<Float64Type>().values();
        for (row, ends) in lists.value_offsets().windows(2).enumerate() {
            let sums = &sums[ends[0] as usize..ends[1] as usize];
            groups.update_at(row, |group| {
                let merged = group.merge_sums(sums, counts[row]);
                merged.map_err(|e| {
                    DataFusionError::Execution(format!("`avg_list`: {e}; hint: group by what has one length"))
                })
            })?;
        }
        Ok(())
    }

    fn group_states(&self, groups: &[SignalMean]) -> Result<Vec<ArrayRef>> {
        let sums: Vec<f64> = groups.iter().flat_map(|group| group.sums().iter().copied()).collect();
        let counts: UInt64Array = groups.iter().map(|group| Some(group.count())).collect();
        Ok(vec![Arc::new(list_array::<f64>(sums, list_offsets(groups)?, None)?), Arc::new(counts)])
    }

    fn group_answers(&self, groups: &[SignalMean], returns: &DataType) -> Result<ArrayRef> {
        match element_type(returns) {
            Some(DataType::Float32) => Self::mean_lists::<f32>(groups),
            _ => Self::mean_lists::<f64>(groups),
        }
    }

    fn heap_bytes(group: &SignalMean) -> usize {
        size_of_val(group.sums())
    }
}

fn list_offsets(groups: &[SignalMean]) -> Result<Vec<i32>> {
    let ends = groups.iter().scan(0usize, |end, group| {
        *end += group.sums().len();
        Some(i32::try_from(*end))
    });
    let offsets: Result<Vec<i32>, _> = std::iter::once(Ok(0)).chain(ends).collect();
    offsets.map_err(|_| {
        DataFusionError::Execution("`avg_list`: more than 2^31 values in a batch; hint: group by less".into())
    })
}
