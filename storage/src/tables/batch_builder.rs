//! Builds rows of a table: each column is given by its name and checked against the table's definition.

use std::sync::Arc;

use arrow::array::{
    Array as _, ArrayRef, AsArray as _, BooleanArray, Float32Array, Float32Builder, Float64Array, Int32Array,
    Int64Array, ListArray, ListBuilder, StringArray, TimestampMicrosecondArray,
};
use arrow::buffer::OffsetBuffer;
use arrow::datatypes::{DataType, Field, Float32Type, Float64Type, SchemaRef};
use arrow::record_batch::RecordBatch;
use echolake_schema::tables::{LIST_CHILD, Table};
use echolake_schema::{Grid, Pair, PointId, Rig, Timestamp};

use crate::{Error, Result};

/// A batch of a table's rows, given column by column in any order. [`Self::finish`] returns the first fault.
pub struct BatchBuilder {
    table: Table,
    schema: SchemaRef,
    rows: usize,
    /// In the table's order; None for columns that are not given yet.
    columns: Vec<Option<ArrayRef>>,
    fault: Option<String>,
}

impl BatchBuilder {
    /// Returns a builder of this number of rows, without columns.
    pub fn new(table: Table, rig: &Rig, rows: usize) -> Self {
        let schema = table.schema(rig);
        Self { table, rows, columns: vec![None; schema.fields().len()], fault: None, schema }
    }

    /// Adds a column.
    pub fn push_column(&mut self, name: &str, array: ArrayRef) -> &mut Self {
        match self.place_column(name, array) {
            Ok(()) => self,
            Err(fault) => self.record_fault(fault),
        }
    }

    /// Adds a column that has the same text, or null, in every row.
    pub fn fill_text<'a>(&mut self, name: &str, text: impl Into<Option<&'a str>>) -> &mut Self {
        let repeated = std::iter::repeat_n(text.into(), self.rows);
        self.push_column(name, Arc::new(repeated.collect::<StringArray>()))
    }

    /// Adds a column of texts.
    pub fn push_texts<T: AsRef<str>>(&mut self, name: &str, values: impl IntoIterator<Item = T>) -> &mut Self {
        self.push_column(name, Arc::new(StringArray::from_iter_values(values)))
    }

    /// Adds a column of truth values, nulls among them.
    pub fn push_flags(&mut self, name: &str, values: impl IntoIterator<Item = impl Into<Option<bool>>>) -> &mut Self {
        self.push_column(name, Arc::new(values.into_iter().map(Into::into).collect::<BooleanArray>()))
    }

    /// Adds a column of 32-bit integers, nulls among them.
    pub fn push_ints(&mut self, name: &str, values: impl IntoIterator<Item = impl Into<Option<i32>>>) -> &mut Self {
        self.push_column(name, Arc::new(values.into_iter().map(Into::into).collect::<Int32Array>()))
    }

    /// Adds a column of 64-bit integers, nulls among them.
    pub fn push_longs(&mut self, name: &str, values: impl IntoIterator<Item = impl Into<Option<i64>>>) -> &mut Self {
        self.push_column(name, Arc::new(values.into_iter().map(Into::into).collect::<Int64Array>()))
    }

    /// Adds a column of numbers of single precision, nulls among them.
    pub fn push_floats(&mut self, name: &str, values: impl IntoIterator<Item = impl Into<Option<f32>>>) -> &mut Self {
        self.push_column(name, Arc::new(values.into_iter().map(Into::into).collect::<Float32Array>()))
    }

    /// Adds a column of numbers of double precision, nulls among them.
    pub fn push_doubles(&mut self, name: &str, values: impl IntoIterator<Item = impl Into<Option<f64>>>) -> &mut Self {
        self.push_column(name, Arc::new(values.into_iter().map(Into::into).collect::<Float64Array>()))
    }

    /// Adds two columns: `<name>_ns`, and `<name>`, which is cut to microseconds.
    pub fn push_times(&mut self, name: &str, nanos: impl IntoIterator<Item = i64>) -> &mut Self {
        let nanos: Vec<i64> = nanos.into_iter().collect();
        let micros = nanos.iter().map(|ns| Timestamp(*ns).micros());
        let micros = TimestampMicrosecondArray::from_iter_values(micros).with_timezone("UTC");
        self.push_column(&format!("{name}_ns"), Arc::new(Int64Array::from(nanos))).push_column(name, Arc::new(micros))
    }

    /// Adds a column of lists of equal length, from their concatenated values.
    pub fn push_lists(&mut self, name: &str, values: Vec<f32>) -> &mut Self {
        let each = values.len().checked_div(self.rows).unwrap_or(0);
        if each * self.rows != values.len() {
            let rows = self.rows;
            let actual = values.len();
            return self
                .record_fault(format!("lists of column `{name}` have {actual} values, expected a multiple of {rows}"));
        }
        let child = Arc::new(Field::new(LIST_CHILD, DataType::Float32, false));
        let offsets = OffsetBuffer::from_repeated_length(each, self.rows);
        self.push_column(name, Arc::new(ListArray::new(child, offsets, Arc::new(Float32Array::from(values)), None)))
    }

    /// Adds a column of lists, nulls among them.
    pub fn push_optional_lists<'a>(
        &mut self,
        name: &str,
        lists: impl IntoIterator<Item = Option<&'a [f32]>>,
    ) -> &mut Self {
        let mut builder = ListBuilder::new(Float32Builder::new());
        builder = builder.with_field(Field::new(LIST_CHILD, DataType::Float32, false));
        for list in lists {
            builder.values().append_slice(list.unwrap_or_default());
            builder.append(list.is_some());
        }
        self.push_column(name, Arc::new(builder.finish()))
    }

    /// Adds three columns: `pair_id`, `microphone` and `speaker`, each after the prefix.
    pub fn push_pairs<'a>(&mut self, prefix: &str, pairs: impl Iterator<Item = Option<&'a Pair>> + Clone) -> &mut Self {
        self.push_ints(&format!("{prefix}pair_id"), pairs.clone().map(|p| Some(p?.id.0 as i32)))
            .push_ints(&format!("{prefix}microphone"), pairs.clone().map(|p| Some(p?.microphone.0 as i32)))
            .push_ints(&format!("{prefix}speaker"), pairs.map(|p| Some(p?.speaker.0 as i32)))
    }

    /// Adds six columns, from `microphone_x_mm` to `speaker_z_mm`: positions of the pairs' points.
    pub fn push_positions<'a>(
        &mut self,
        grid: &Grid,
        pairs: impl Iterator<Item = Option<&'a Pair>> + Clone,
    ) -> &mut Self {
        for (i, axis) in ["x", "y", "z"].into_iter().enumerate() {
            let along = |point: PointId| Some(grid.point(point)?.position_mm[i]);
            self.push_doubles(&format!("microphone_{axis}_mm"), pairs.clone().map(|p| along(p?.microphone)))
                .push_doubles(&format!("speaker_{axis}_mm"), pairs.clone().map(|p| along(p?.speaker)));
        }
        self
    }

    /// Takes all columns that are not given yet from other rows of the table.
    pub fn take_rest(&mut self, rows: &RecordBatch) -> &mut Self {
        for (column, field) in self.columns.iter_mut().zip(self.schema.fields()) {
            *column = column.take().or_else(|| rows.column_by_name(field.name()).cloned());
        }
        self
    }

    /// Returns the batch, in the table's order of columns.
    ///
    /// # Errors
    /// [`Error::Encode`] if a column is unknown, missing or given twice, or does not have the type, the number of rows
    /// or the nulls that the table's definition allows.
    pub fn finish(&mut self) -> Result<RecordBatch> {
        let columns = self.columns.iter_mut().zip(self.schema.fields()).map(|(column, field)| {
            column.take().ok_or_else(|| format!("column `{}` is missing, expected {}", field.name(), field.data_type()))
        });
        let columns: std::result::Result<Vec<_>, String> = columns.collect();
        let columns = self.fault.take().map_or(columns, Err);
        let made = columns.and_then(|all| RecordBatch::try_new(self.schema.clone(), all).map_err(|e| e.to_string()));
        made.map_err(|reason| Error::Encode { table: self.table.name(), reason })
    }

    fn record_fault(&mut self, fault: String) -> &mut Self {
        self.fault.get_or_insert(fault);
        self
    }

    fn place_column(&mut self, name: &str, array: ArrayRef) -> std::result::Result<(), String> {
        let fields = self.schema.fields();
        let Some((index, field)) = fields.find(name) else {
            let names: Vec<_> = fields.iter().map(|f| f.name().as_str()).collect();
            return Err(format!("no column `{name}`, expected one of {}", names.join(", ")));
        };
        if array.data_type() != field.data_type() {
            return Err(format!("column `{name}` is {}, expected {}", array.data_type(), field.data_type()));
        }
        if array.len() != self.rows {
            return Err(format!("column `{name}` has {} rows, expected {}", array.len(), self.rows));
        }
        if !field.is_nullable() && array.null_count() > 0 {
            return Err(format!("column `{name}` has {} nulls, expected none", array.null_count()));
        }
        match self.columns[index].replace(without_negative_zero(array)) {
            Some(_) => Err(format!("column `{name}` is given twice, expected once")),
            None => Ok(()),
        }
    }
}

// Arrow's order of floats is that of their bits, in which -0.0 is not 0.0. Orders of a table's columns rely on it.
fn without_negative_zero(array: ArrayRef) -> ArrayRef {
    match array.data_type() {
        DataType::Float32 => Arc::new(array.as_primitive::<Float32Type>().unary::<_, Float32Type>(|x| x + 0.0)),
        DataType::Float64 => Arc::new(array.as_primitive::<Float64Type>().unary::<_, Float64Type>(|x| x + 0.0)),
        _ => array,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn heights(fill: fn(&mut BatchBuilder) -> &mut BatchBuilder) -> std::result::Result<RecordBatch, String> {
        let mut columns = BatchBuilder::new(Table::Heightmaps, &Rig::paper(), 2);
        columns.fill_text("surface_id", "flat").fill_text("run_id", "r1").fill_text("code_version", "1");
        fill(
            columns
                .push_ints("cells", [1, 1])
                .push_texts("symmetry", ["identity", "rot90"])
                .push_lists("heights_mm", vec![0.0; 2]),
        );
        columns.finish().map_err(|e| e.to_string())
    }

    #[test]
    fn zeros_have_no_sign() {
        let batch = heights(|columns| columns.push_floats("size_mm", [-0.0, 600.0])).expect("complete");
        let sizes = batch.column_by_name("size_mm").expect("there");
        assert!(sizes.as_primitive::<Float32Type>().value(0).is_sign_positive());
    }

    #[test]
    fn columns_come_in_any_order_and_leave_in_the_tables() {
        let batch = heights(|columns| columns.push_floats("size_mm", [600.0, 600.0])).expect("complete");
        assert_eq!(batch.schema(), Table::Heightmaps.schema(&Rig::paper()));
        let rest = BatchBuilder::new(Table::Heightmaps, &Rig::paper(), 2)
            .push_ints("cells", [2, 3])
            .take_rest(&batch)
            .finish();
        let rest = rest.expect("complete");
        assert_eq!(rest.column_by_name("cells").expect("there").as_ref(), &Int32Array::from(vec![2, 3]));
        assert_eq!(rest.column_by_name("size_mm"), batch.column_by_name("size_mm"));
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let check = |fill: fn(&mut BatchBuilder) -> &mut BatchBuilder, expected: &str| {
            let error = heights(fill).expect_err(expected);
            assert_eq!(error, format!("rows of table `heightmaps` cannot be encoded: {expected}"));
        };
        check(|columns| columns, "column `size_mm` is missing, expected Float32");
        check(
            |columns| columns.push_floats("size", [1.0, 1.0]),
            "no column `size`, expected one of surface_id, run_id, symmetry, cells, size_mm, heights_mm, code_version",
        );
        check(|columns| columns.push_doubles("size_mm", [1.0, 1.0]), "column `size_mm` is Float64, expected Float32");
        check(|columns| columns.push_ints("cells", [1, 1]), "column `cells` is given twice, expected once");
        check(|columns| columns.push_floats("size_mm", [1.0]), "column `size_mm` has 1 rows, expected 2");
        check(
            |columns| columns.push_floats("size_mm", [Some(1.0), None]),
            "column `size_mm` has 1 nulls, expected none",
        );
        check(
            |columns| columns.push_lists("heights_mm", vec![0.0; 3]),
            "lists of column `heights_mm` have 3 values, expected a multiple of 2",
        );
    }

    #[test]
    fn twin_columns_follow_from_one_name() {
        let rig = Rig::paper();
        let grid = rig.build_grid().expect("a grid");
        let mut columns = BatchBuilder::new(Table::Events, &rig, 1);
        columns
            .fill_text("surface_id", "flat")
            .fill_text("run_id", "r1")
            .fill_text("code_version", "1")
            .push_times("log_time", [1_999]);
        let batch =
            columns.push_texts("level", ["info"]).push_texts("name", ["rig"]).push_texts("message", [""]).finish();
        let batch = batch.expect("complete");
        assert_eq!(batch.column_by_name("log_time_ns").expect("there").as_ref(), &Int64Array::from(vec![1_999]));
        let micros = TimestampMicrosecondArray::from(vec![1]).with_timezone("UTC");
        assert_eq!(batch.column_by_name("log_time").expect("there").as_ref(), &micros);
        let mut columns = BatchBuilder::new(Table::Pairs, &rig, 1);
        let pairs = [grid.pairs().get(7)];
        columns.push_pairs("", pairs.into_iter()).push_positions(&grid, pairs.into_iter());
        let missing = columns.finish().expect_err("more columns").to_string();
        assert!(missing.ends_with("column `direct_mm` is missing, expected Float64"), "{missing}");
    }
}
