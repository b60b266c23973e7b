//! `pearson` and `similarity`: similarity measures of two lists.

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::error::Result;
use echolake_dsp::Error;
use echolake_dsp::correlation::{CorrelationPlan, pearson};

use crate::adapters::answers::build_numbers;
use crate::adapters::arguments::{CallArguments, SampleElement};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};
use crate::adapters::per_length::PerLength;
use crate::adapters::scalar::ScalarKernel;

/// `pearson`.
pub(crate) struct PearsonFunction;

/// `similarity`.
pub(crate) struct SimilarityFunction;

static PEARSON: FunctionDescription = FunctionDescription {
    name: "pearson",
    family: FunctionFamily::Comparison,
    about: "Pearson's coefficient of correlation of two equally long lists, -1 to 1, without unit. Null where one of \
            them does not vary, is shorter than two, or is not finite. Of two columns, corr() is the aggregate.",
    parameters: &[
        FunctionParameter { name: "x", kind: ArgumentKind::Samples, about: "the first list" },
        FunctionParameter { name: "y", kind: ArgumentKind::Samples, about: "the second list, as long as the first" },
    ],
    optional: 0,
    example: "select round(pearson([1, 2, 3], [5, 7, 9]), 6) as alike, pearson([1, 2, 3], [4, 4, 4]) as \
              constant",
    answer: "\
+-------+----------+
| alike | constant |
+-------+----------+
| 1.0   |          |
+-------+----------+",
    related: &["similarity"],
};

static SIMILARITY: FunctionDescription = FunctionDescription {
    name: "similarity",
    family: FunctionFamily::Comparison,
    about: "Greatest normalised cross-correlation of two equally long responses over all shifts, up to 1, without \
            unit: 1 where one is the other, later or louder, whatever its level; an inverted one is not alike. Null \
            where one has no energy.",
    parameters: &[
        FunctionParameter { name: "ir", kind: ArgumentKind::Samples, about: "the first response" },
        FunctionParameter {
            name: "other",
            kind: ArgumentKind::Samples,
            about: "the second response, as long as the first",
        },
    ],
    optional: 0,
    example: "select round(similarity([1, -2, 0, 0], [0, 0, 3, -6]), 6) as alike",
    answer: "\
+-------+
| alike |
+-------+
| 1.0   |
+-------+",
    related: &["pearson", "arrival"],
};

impl ScalarKernel for PearsonFunction {
    fn description(&self) -> &'static FunctionDescription {
        &PEARSON
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let x = arguments.sample_lists::<T>(0)?;
        let y = arguments.sample_lists::<T>(1)?;
        build_numbers(arguments, |row| {
            pearson(x.samples_at(row)?, y.samples_at(row)?).map_err(|e| arguments.refused_row(row, &e))
        })
    }
}

impl ScalarKernel for SimilarityFunction {
    fn description(&self) -> &'static FunctionDescription {
        &SIMILARITY
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let x = arguments.sample_lists::<T>(0)?;
        let y = arguments.sample_lists::<T>(1)?;
        let mut plans = PerLength::new(SIMILARITY.name);
        build_numbers(arguments, |row| {
            let x = x.samples_at(row)?;
            let y = y.samples_at(row)?;
            if x.len() != y.len() {
                let error = Error::Length { what: "the second response", actual: y.len(), expected: x.len() };
                return Err(arguments.refused_row(row, &error));
            }
            if x.is_empty() {
                return Ok(None);
            }
            let (plan, scratch) = plans.plan_for(x.len(), |len| {
                let plan = CorrelationPlan::<T>::new(len)?;
                let scratch = plan.make_scratch();
                Ok((plan, scratch))
            })?;
            plan.compute_similarity(x, y, scratch).map_err(|e| arguments.refused_row(row, &e))
        })
    }
}
