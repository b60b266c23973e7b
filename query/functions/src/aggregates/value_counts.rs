//! `mode` and `histogram`: how often each value occurs.

use std::cmp::Ordering;
use std::collections::HashMap;
use std::sync::Arc;

use arrow::array::{Array, ArrayRef, AsArray as _, Int64Array, MapArray, StructArray};
use arrow::buffer::OffsetBuffer;
use arrow::datatypes::{DataType, Field, FieldRef, Fields, Int64Type};
use datafusion::common::ScalarValue;
use datafusion::error::{DataFusionError, Result};
use datafusion::logical_expr::function::{AccumulatorArgs, StateFieldsArgs};
use datafusion::logical_expr::utils::format_state_name;
use datafusion::logical_expr::{Accumulator, AggregateUDFImpl, Documentation, Signature, Volatility};

use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};

static MODE: FunctionDescription = FunctionDescription {
    name: "mode",
    family: FunctionFamily::Aggregates,
    about: "The most frequent value; of several the least. Null values do not count; null of none.",
    parameters: &[FunctionParameter { name: "x", kind: ArgumentKind::Value, about: "the values" }],
    optional: 0,
    example: "select mode(x) as mode from (values (2), (1), (2), (1), (3)) as t(x)",
    answer: "\
+------+
| mode |
+------+
| 1    |
+------+",
    related: &["histogram"],
};

static HISTOGRAM: FunctionDescription = FunctionDescription {
    name: "histogram",
    family: FunctionFamily::Aggregates,
    about: "A map of each value to the number of rows that have it, in the order of the values. Round numbers first: \
            `histogram(round(snr_db, -1))` counts by tens. Null values do not count; null of none.",
    parameters: &[FunctionParameter { name: "x", kind: ArgumentKind::Value, about: "the values" }],
    optional: 0,
    example: "select histogram(round(x, -1)) as tens from (values (12.5), (9.0), (31.0), (33.0)) as t(x)",
    answer: "\
+--------------------+
| tens               |
+--------------------+
| {10.0: 2, 30.0: 2} |
+--------------------+",
    related: &["mode"],
};

/// An aggregate of the values' counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum CountAnswer {
    Mode,
    Histogram,
}

/// `mode` and `histogram` as DataFusion knows them.
#[derive(Debug, PartialEq, Eq, Hash)]
pub(crate) struct ValueCountFunction {
    answer: CountAnswer,
    signature: Signature,
    documentation: Documentation,
}

impl ValueCountFunction {
    pub fn mode() -> Self {
        Self::new(CountAnswer::Mode, &MODE)
    }

    pub fn histogram() -> Self {
        Self::new(CountAnswer::Histogram, &HISTOGRAM)
    }

    fn new(answer: CountAnswer, description: &FunctionDescription) -> Self {
        let signature = Signature::any(1, Volatility::Immutable);
        Self { answer, signature, documentation: description.build_documentation() }
    }
}

impl AggregateUDFImpl for ValueCountFunction {
    fn name(&self) -> &str {
        match self.answer {
            CountAnswer::Mode => MODE.name,
            CountAnswer::Histogram => HISTOGRAM.name,
        }
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn return_type(&self, types: &[DataType]) -> Result<DataType> {
        let [of] = types else {
            return Err(DataFusionError::Plan(format!(
                "`{}` takes one argument; hint: {}(x)",
                self.name(),
                self.name()
            )));
        };
        Ok(match self.answer {
            CountAnswer::Mode => of.clone(),
            CountAnswer::Histogram => DataType::Map(entries_field(of), false),
        })
    }

    fn state_fields(&self, args: StateFieldsArgs) -> Result<Vec<FieldRef>> {
        let list = |name: &str, of: &DataType| {
            Arc::new(Field::new(format_state_name(args.name, name), DataType::new_list(of.clone(), true), true))
        };
        Ok(vec![list("values", args.input_fields[0].data_type()), list("counts", &DataType::Int64)])
    }

    fn accumulator(&self, args: AccumulatorArgs) -> Result<Box<dyn Accumulator>> {
        if args.is_distinct {
            let name = self.name();
            return Err(DataFusionError::Plan(format!(
                "`{name}` knows no DISTINCT; hint: each value once is array_agg(DISTINCT x)"
            )));
        }
        let of = args.exprs[0].data_type(args.schema)?;
        Ok(Box::new(ValueCounts { answer: self.answer, of, counts: HashMap::new(), heap: 0 }))
    }

    fn documentation(&self) -> Option<&Documentation> {
        Some(&self.documentation)
    }
}

fn entries_field(of: &DataType) -> FieldRef {
    Arc::new(Field::new("entries", DataType::Struct(entry_fields(of)), false))
}

fn entry_fields(of: &DataType) -> Fields {
    Fields::from(vec![Field::new("keys", of.clone(), false), Field::new("values", DataType::Int64, true)])
}

#[derive(Debug)]
struct ValueCounts {
    answer: CountAnswer,
    of: DataType,
    counts: HashMap<ScalarValue, i64>,
    /// Bytes that the values hold beside the map's own.
    heap: usize,
}

impl ValueCounts {
    fn add_value(&mut self, values: &dyn Array, row: usize, count: i64) -> Result<()> {
        let value = ScalarValue::try_from_array(values, row)?;
        if value.is_null() {
            return Ok(());
        }
        match self.counts.get_mut(&value) {
            Some(known) => *known += count,
            None => {
                self.heap += value.size().saturating_sub(size_of::<ScalarValue>());
                self.counts.insert(value, count);
            }
        }
        Ok(())
    }

    fn sorted_counts(&self) -> Vec<(&ScalarValue, i64)> {
        let mut sorted: Vec<_> = self.counts.iter().map(|(value, count)| (value, *count)).collect();
        sorted.sort_by(|(a, _), (b, _)| a.partial_cmp(b).unwrap_or(Ordering::Equal));
        sorted
    }

    fn mode_value(&self) -> Result<ScalarValue> {
        let sorted = self.sorted_counts();
        let most = sorted.iter().map(|(_, count)| *count).max();
        match sorted.into_iter().find(|(_, count)| Some(*count) == most) {
            Some((value, _)) => Ok(value.clone()),
            None => ScalarValue::try_from(&self.of),
        }
    }

    fn histogram_map(&self) -> Result<ScalarValue> {
        let sorted = self.sorted_counts();
        if sorted.is_empty() {
            return ScalarValue::try_from(&DataType::Map(entries_field(&self.of), false));
        }
        let counts: Int64Array = sorted.iter().map(|(_, count)| Some(*count)).collect();
        let offsets = OffsetBuffer::from_lengths([sorted.len()]);
        let values = ScalarValue::iter_to_array(sorted.into_iter().map(|(value, _)| value.clone()))?;
        let entries = StructArray::try_new(entry_fields(&self.of), vec![values, Arc::new(counts)], None)?;
        let map = MapArray::try_new(entries_field(&self.of), offsets, entries, None, false)?;
        Ok(ScalarValue::Map(Arc::new(map)))
    }
}

impl Accumulator for ValueCounts {
    fn update_batch(&mut self, values: &[ArrayRef]) -> Result<()> {
        (0..values[0].len()).try_for_each(|row| self.add_value(&values[0], row, 1))
    }

    fn merge_batch(&mut self, states: &[ArrayRef]) -> Result<()> {
        let values = states[0].as_list::<i32>();
        let counts = states[1].as_list::<i32>();
        for row in 0..values.len() {
            let values = values.value(row);
            let counts = counts.value(row);
            let counts = counts.as_primitive::<Int64Type>();
            (0..values.len()).try_for_each(|at| self.add_value(&values, at, counts.value(at)))?;
        }
        Ok(())
    }

    fn state(&mut self) -> Result<Vec<ScalarValue>> {
        let (values, counts): (Vec<_>, Vec<_>) =
            self.sorted_counts().into_iter().map(|(value, count)| (value.clone(), ScalarValue::from(count))).unzip();
        Ok(vec![
            ScalarValue::List(ScalarValue::new_list_nullable(&values, &self.of)),
            ScalarValue::List(ScalarValue::new_list_nullable(&counts, &DataType::Int64)),
        ])
    }

    fn evaluate(&mut self) -> Result<ScalarValue> {
        match self.answer {
            CountAnswer::Mode => self.mode_value(),
            CountAnswer::Histogram => self.histogram_map(),
        }
    }

    fn size(&self) -> usize {
        size_of::<Self>() + self.counts.capacity() * size_of::<(ScalarValue, i64)>() + self.heap
    }
}
