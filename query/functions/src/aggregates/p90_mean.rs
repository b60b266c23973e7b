//! `p90_mean`: the mean that the paper's tables and table `surface_stats` use.

use std::sync::Arc;

use arrow::array::{ArrayRef, AsArray as _, Float64Array};
use arrow::datatypes::{DataType, Float64Type};
use datafusion::error::{DataFusionError, Result};
use echolake_dsp::level::p90_mean;

use crate::adapters::aggregate::{AggregateKernel, GroupStates};
use crate::adapters::answers::list_array;
use crate::adapters::arguments::{CallArguments, list_of};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};

/// `p90_mean`.
#[derive(Clone)]
pub(crate) struct P90MeanFunction;

static DESCRIPTION: FunctionDescription = FunctionDescription {
    name: "p90_mean",
    family: FunctionFamily::Aggregates,
    about: "Mean of the values up to their 90th percentile, which a few focusing pairs do not carry away, in the unit \
            of x. Of TNCE, which is linear, `db(p90_mean(tnce_total))` is what the paper's tables and \
            surface_stats.p90_mean_db say. Null values and those that are not finite do not count; null of none.",
    parameters: &[FunctionParameter {
        name: "x",
        kind: ArgumentKind::Number,
        about: "the values, as tnce_total (linear, not dB)",
    }],
    optional: 0,
    example: "select p90_mean(x) as mean from (values (1), (2), (3), (4), (1000)) as t(x)",
    answer: "\
+------+
| mean |
+------+
| 2.5  |
+------+",
    related: &["db", "diffusion_coefficient"],
};

impl AggregateKernel for P90MeanFunction {
    type Group = Vec<f64>;

    fn description(&self) -> &'static FunctionDescription {
        &DESCRIPTION
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn state_columns(&self) -> Vec<(&'static str, DataType)> {
        vec![("values", list_of(DataType::Float64))]
    }

    fn update_groups(&self, arguments: &CallArguments<'_>, groups: &mut GroupStates<'_, Self>) -> Result<()> {
        let values = arguments.number_values(0)?;
        for row in
            (0..arguments.row_count()).filter(|row| !arguments.is_null(*row) && values.value_at(*row).is_finite())
        {
            groups.update_at(row, |group| {
                group.push(values.value_at(row));
                Ok(())
            })?;
        }
        Ok(())
    }

    fn merge_states(&self, states: &[ArrayRef], groups: &mut GroupStates<'_, Self>) -> Result<()> {
        let lists = states[0].as_list::<i32>();
        let values = lists.values().as_primitive::<Float64Type>().values();
        for (row, ends) in lists.value_offsets().windows(2).enumerate() {
            groups.update_at(row, |group| {
                group.extend_from_slice(&values[ends[0] as usize..ends[1] as usize]);
                Ok(())
            })?;
        }
        Ok(())
    }

    fn group_states(&self, groups: &[Vec<f64>]) -> Result<Vec<ArrayRef>> {
        let mut offsets = vec![0];
        let mut end = 0usize;
        for group in groups {
            end += group.len();
            offsets.push(i32::try_from(end).map_err(|_| {
                DataFusionError::Execution("`p90_mean`: more than 2^31 values in a batch; hint: group by more".into())
            })?);
        }
        Ok(vec![Arc::new(list_array::<f64>(groups.concat(), offsets, None)?)])
    }

    fn group_answers(&self, groups: &[Vec<f64>], _: &DataType) -> Result<ArrayRef> {
        let mut scratch = Vec::new();
        Ok(Arc::new(groups.iter().map(|group| p90_mean(group, &mut scratch)).collect::<Float64Array>()))
    }

    fn heap_bytes(group: &Vec<f64>) -> usize {
        group.capacity() * size_of::<f64>()
    }
}
