//! The function in plans that tells whether a measurement is rejected. The verdicts are its arguments, so that a plan
//! means the same on every process.

use std::collections::HashSet;
use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _, BooleanArray, StringArray};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Int64Type};
use datafusion::common::utils::{SingleRowListArrayBuilder, take_function_args};
use datafusion::error::{DataFusionError, Result};
use datafusion::logical_expr::{
    ColumnarValue, Expr, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature, Volatility,
};
use datafusion::scalar::ScalarValue;

/// What is rejected of a run whose measurements are all rejected, or all but some.
const ALL: &str = "all";
const ALL_BUT: &str = "all but ";

/// The rejections of some runs, by name: `all`, `all but 3 7` or `3 7`, as
/// [`echolake_schema::annotations::RejectedMeasurements`] describes them.
#[derive(Debug, Clone)]
pub(crate) struct ListedVerdicts {
    runs: StringArray,
    rejections: StringArray,
}

impl ListedVerdicts {
    /// Makes a list of runs with what is rejected of each; the runs must be in order.
    pub fn from_rejections(rejections: impl IntoIterator<Item = (String, String)>) -> Self {
        let (runs, rejections): (Vec<_>, Vec<_>) = rejections.into_iter().unzip();
        Self { runs: runs.into(), rejections: rejections.into() }
    }

    /// Returns whether nothing is rejected.
    pub fn is_empty(&self) -> bool {
        self.runs.is_empty()
    }

    /// Returns the expression that tells whether a measurement, given as run and pair, is rejected.
    pub fn rejection_expr(&self, run: Expr, pair: Expr) -> Expr {
        let list = |texts: &StringArray| {
            let list = SingleRowListArrayBuilder::new(Arc::new(texts.clone())).build_list_scalar();
            Expr::Literal(list, None)
        };
        listed_rejection().call(vec![run, pair, list(&self.runs), list(&self.rejections)])
    }

    /// Returns which of these measurements are rejected; null for one without a run or a pair.
    ///
    /// # Errors
    /// If the columns are no texts and whole numbers.
    pub fn judge_measurements(&self, runs: &ArrayRef, pairs: &ArrayRef) -> Result<BooleanArray> {
        let runs = cast(runs, &DataType::Utf8)?;
        let pairs = cast(pairs, &DataType::Int64)?;
        // Rows of a run are neighbours.
        let mut last: Option<(&str, RunRejection)> = None;
        let rows = runs.as_string::<i32>().iter().zip(pairs.as_primitive::<Int64Type>());
        let judged = rows.map(|(run, pair)| {
            let run = run?;
            let pair = pair?;
            let rejection = match &mut last {
                Some((known, rejection)) if *known == run => rejection,
                last => &mut last.insert((run, self.find_rejection(run))).1,
            };
            Some(rejection.has_pair(pair))
        });
        Ok(judged.collect())
    }

    fn find_rejection(&self, run: &str) -> RunRejection {
        let mut places = 0..self.runs.len();
        while !places.is_empty() {
            let middle = places.start + places.len() / 2;
            match self.runs.value(middle).cmp(run) {
                std::cmp::Ordering::Equal => return RunRejection::from_text(self.rejections.value(middle)),
                std::cmp::Ordering::Less => places.start = middle + 1,
                std::cmp::Ordering::Greater => places.end = middle,
            }
        }
        RunRejection::default()
    }

    // The lists as they are in a plan.
    fn from_lists(runs: &ColumnarValue, rejections: &ColumnarValue) -> Result<Self> {
        let texts = |list: &ColumnarValue| match list {
            ColumnarValue::Scalar(ScalarValue::List(list)) if list.len() == 1 => {
                list.value(0).as_string_opt::<i32>().cloned()
            }
            _ => None,
        };
        let lists = texts(runs).zip(texts(rejections)).filter(|(runs, rejections)| runs.len() == rejections.len());
        let (runs, rejections) =
            lists.ok_or_else(|| DataFusionError::Internal("verdicts are two lists of texts".to_owned()))?;
        Ok(Self { runs, rejections })
    }
}

/// What is rejected of one run.
#[derive(Debug, Default)]
struct RunRejection {
    is_rejected: bool,
    /// The pairs of which the contrary holds.
    others: HashSet<i64>,
}

impl RunRejection {
    fn from_text(text: &str) -> Self {
        let (is_rejected, pairs) = match text {
            ALL => (true, ""),
            text => text.strip_prefix(ALL_BUT).map_or((false, text), |pairs| (true, pairs)),
        };
        Self { is_rejected, others: pairs.split(' ').filter_map(|pair| pair.parse().ok()).collect() }
    }

    fn has_pair(&self, pair: i64) -> bool {
        self.is_rejected != self.others.contains(&pair)
    }
}

/// `has_listed_rejection(run_id, pair_id, [runs], [rejections])`.
#[derive(Debug, PartialEq, Eq, Hash)]
struct ListedRejection(Signature);

/// Returns the function.
pub(crate) fn listed_rejection() -> ScalarUDF {
    ScalarUDF::new_from_impl(ListedRejection(Signature::any(4, Volatility::Immutable)))
}

impl ScalarUDFImpl for ListedRejection {
    fn name(&self) -> &str {
        "has_listed_rejection"
    }

    fn signature(&self) -> &Signature {
        &self.0
    }

    fn return_type(&self, _: &[DataType]) -> Result<DataType> {
        Ok(DataType::Boolean)
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        let rows = args.number_rows;
        let [run, pair, runs, rejections] = take_function_args(self.name(), args.args)?;
        let listed = ListedVerdicts::from_lists(&runs, &rejections)?;
        let judged = listed.judge_measurements(&run.into_array(rows)?, &pair.into_array(rows)?)?;
        Ok(ColumnarValue::Array(Arc::new(judged)))
    }
}

#[cfg(test)]
mod tests {
    use arrow::array::Int32Array;

    use super::*;

    #[test]
    fn runs_and_pairs_are_judged_by_the_lists() {
        let listed = [("a", "all"), ("b", "3 7"), ("d", "all but 2")];
        let verdicts = ListedVerdicts::from_rejections(listed.map(|(run, text)| (run.to_owned(), text.to_owned())));
        let rows = [
            (Some("a"), Some(0), Some(true)),
            (Some("b"), Some(3), Some(true)),
            (Some("b"), Some(4), Some(false)),
            (Some("b"), Some(7), Some(true)),
            (Some("c"), Some(3), Some(false)),
            (Some("d"), Some(2), Some(false)),
            (Some("d"), Some(9), Some(true)),
            (Some("a"), Some(-1), Some(true)),
            (None, Some(3), None),
            (Some("a"), None, None),
        ];
        let runs: ArrayRef = Arc::new(rows.iter().map(|row| row.0).collect::<StringArray>());
        let pairs: ArrayRef = Arc::new(rows.iter().map(|row| row.1).collect::<Int32Array>());
        let expected: BooleanArray = rows.iter().map(|row| row.2).collect();
        assert_eq!(verdicts.judge_measurements(&runs, &pairs).expect("judged"), expected);
        let nothing = ListedVerdicts::from_rejections([]);
        assert_eq!(nothing.judge_measurements(&runs, &pairs).expect("judged").true_count(), 0);
    }
}
