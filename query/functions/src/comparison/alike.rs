//! `pearson`, `spearman`, `correlation_p`, `similarity` and `rms_difference`: how alike two lists are.

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::error::Result;
use echolake_dsp::Error;
use echolake_dsp::correlation::{CorrelationPlan, pearson, rms_difference, spearman};
use echolake_dsp::significance::correlation_p_value;

use crate::adapters::answers::build_numbers;
use crate::adapters::arguments::{CallArguments, SampleElement};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};
use crate::adapters::per_length::PerLength;
use crate::adapters::scalar::ScalarKernel;

/// `pearson`.
pub(crate) struct PearsonFunction;

/// `spearman`.
pub(crate) struct SpearmanFunction;

/// `correlation_p`.
pub(crate) struct CorrelationPFunction;

/// `similarity`.
pub(crate) struct SimilarityFunction;

/// `rms_difference`.
pub(crate) struct RmsDifferenceFunction;

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
    related: &["spearman", "correlation_p", "similarity", "rms_difference"],
};

static SPEARMAN: FunctionDescription = FunctionDescription {
    name: "spearman",
    family: FunctionFamily::Comparison,
    about: "Spearman's coefficient of correlation of two equally long lists: Pearson's of their ranks, so that it is 1 \
            for any rising relation, and an outlier counts no more than another value. Null as of pearson.",
    parameters: PEARSON.parameters,
    optional: 0,
    example: "select round(spearman([1, 2, 3, 4], [1, 10, 100, 1000]), 6) as r",
    answer: "\
+-----+
| r   |
+-----+
| 1.0 |
+-----+",
    related: &["pearson", "correlation_p"],
};

static CORRELATION_P: FunctionDescription = FunctionDescription {
    name: "correlation_p",
    family: FunctionFamily::Comparison,
    about: "Probability, two-sided, that chance alone makes a correlation of this size or greater: by Student's t, \
            exact for Pearson's coefficient of normally distributed values, the usual approximation for Spearman's. \
            Null of fewer than three pairs of values. Of many correlations some are always small: the smallest of 90 \
            is about 0.01 by chance. The 95 % interval of r is tanh(atanh(r) - 1.96 / sqrt(n - 3)) to tanh(atanh(r) + \
            1.96 / sqrt(n - 3)).",
    parameters: &[
        FunctionParameter { name: "r", kind: ArgumentKind::Number, about: "the coefficient, such as corr(x, y)" },
        FunctionParameter {
            name: "n",
            kind: ArgumentKind::Integer,
            about: "number of pairs of values, such as count(*)",
        },
    ],
    optional: 0,
    example: "select round(correlation_p(0.632, 10), 4) as p",
    answer: "\
+------+
| p    |
+------+
| 0.05 |
+------+",
    related: &["pearson", "spearman"],
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

static RMS_DIFFERENCE: FunctionDescription = FunctionDescription {
    name: "rms_difference",
    family: FunctionFamily::Comparison,
    about: "Distance of two equally long lists, in their unit: the root mean square of their differences, which is the \
            Euclidean distance over the root of their length. For curves and for levels. Of responses with little in \
            common it finds the quietest nearest: pearson() compares their shapes. Null of no elements, or if an \
            element is not finite.",
    parameters: &[
        FunctionParameter { name: "x", kind: ArgumentKind::Samples, about: "the first list, as nce_10000" },
        FunctionParameter { name: "y", kind: ArgumentKind::Samples, about: "the second list, as long as the first" },
    ],
    optional: 0,
    example: "select surface, round(rms_difference(curve, [0, 0.5, 0.8]), 4) as apart from (values ('a', [0, 0.5, \
              0.9]), ('b', [0, 0.1, 0.2])) as curves(surface, curve) order by apart",
    answer: "\
+---------+--------+
| surface | apart  |
+---------+--------+
| a       | 0.0577 |
| b       | 0.4163 |
+---------+--------+",
    related: &["pearson", "similarity", "list_rms"],
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

impl ScalarKernel for SpearmanFunction {
    fn description(&self) -> &'static FunctionDescription {
        &SPEARMAN
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let x = arguments.sample_lists::<T>(0)?;
        let y = arguments.sample_lists::<T>(1)?;
        build_numbers(arguments, |row| {
            spearman(x.samples_at(row)?, y.samples_at(row)?).map_err(|e| arguments.refused_row(row, &e))
        })
    }
}

impl ScalarKernel for CorrelationPFunction {
    fn description(&self) -> &'static FunctionDescription {
        &CORRELATION_P
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let coefficients = arguments.number_values(0)?;
        let counts = arguments.integer_values(1)?;
        build_numbers(arguments, |row| {
            let count = usize::try_from(counts.value_at(row)).unwrap_or(0);
            Ok(correlation_p_value(coefficients.value_at(row), count))
        })
    }
}

impl ScalarKernel for RmsDifferenceFunction {
    fn description(&self) -> &'static FunctionDescription {
        &RMS_DIFFERENCE
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let x = arguments.sample_lists::<T>(0)?;
        let y = arguments.sample_lists::<T>(1)?;
        build_numbers(arguments, |row| {
            rms_difference(x.samples_at(row)?, y.samples_at(row)?).map_err(|e| arguments.refused_row(row, &e))
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
