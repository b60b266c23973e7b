//! Mean and standard deviation of each column over split train, by which loaders normalise.

use std::collections::BTreeMap;

use arrow::array::AsArray as _;
use arrow::datatypes::{DataType, Float32Type};
use arrow::record_batch::RecordBatch;
use serde_json::{Value, json};

/// Length of a position, whose axes have a mean and a standard deviation each.
const AXES: i32 = 3;

/// Sums over the values of each column of numbers.
#[derive(Debug, Default)]
pub(super) struct ColumnStatistics(BTreeMap<String, Vec<ValueSums>>);

#[derive(Debug, Default, Clone, Copy)]
struct ValueSums {
    count: u64,
    sum: f64,
    sum_of_squares: f64,
}

impl ColumnStatistics {
    /// Adds the finite values of a batch.
    pub fn add_batch(&mut self, batch: &RecordBatch) {
        for (field, array) in batch.schema().fields().iter().zip(batch.columns()) {
            let (values, width) = match field.data_type() {
                DataType::Float32 => (array, 1),
                DataType::FixedSizeList(_, AXES) => (array.as_fixed_size_list().values(), AXES as usize),
                DataType::FixedSizeList(..) => (array.as_fixed_size_list().values(), 1),
                _ => continue,
            };
            let sums = self.0.entry(field.name().clone()).or_insert_with(|| vec![ValueSums::default(); width]);
            for (i, value) in values.as_primitive::<Float32Type>().iter().enumerate() {
                if let Some(value) = value.filter(|value| value.is_finite()) {
                    sums[i % width].add_value(value.into());
                }
            }
        }
    }

    /// Adds the sums of other rows.
    pub fn merge_sums(&mut self, others: Self) {
        for (name, others) in others.0 {
            let sums = self.0.entry(name).or_insert_with(|| vec![ValueSums::default(); others.len()]);
            sums.iter_mut().zip(others).for_each(|(sums, other)| sums.merge_with(other));
        }
    }

    /// Returns the text of `statistics.json`.
    pub fn to_json(&self) -> String {
        let columns: BTreeMap<_, _> = self.0.iter().map(|(name, sums)| (name, column_json(sums))).collect();
        format!("{:#}\n", json!({ "split": "train", "columns": columns }))
    }
}

fn column_json(sums: &[ValueSums]) -> Value {
    let per_axis = |of: fn(&ValueSums) -> Option<f64>| match sums {
        [sums] => json!(of(sums)),
        axes => json!(axes.iter().map(of).collect::<Vec<_>>()),
    };
    json!({
        "values": sums.iter().map(|sums| sums.count).sum::<u64>(),
        "mean": per_axis(ValueSums::mean),
        "standard_deviation": per_axis(ValueSums::standard_deviation),
    })
}

impl ValueSums {
    fn add_value(&mut self, value: f64) {
        self.count += 1;
        self.sum += value;
        self.sum_of_squares += value * value;
    }

    fn merge_with(&mut self, other: Self) {
        self.count += other.count;
        self.sum += other.sum;
        self.sum_of_squares += other.sum_of_squares;
    }

    fn mean(&self) -> Option<f64> {
        (self.count > 0).then(|| self.sum / self.count as f64)
    }

    fn standard_deviation(&self) -> Option<f64> {
        let mean = self.mean()?;
        Some((self.sum_of_squares / self.count as f64 - mean * mean).max(0.0).sqrt())
    }
}
