//! One column of a table: name, type, unit and meaning.

use std::collections::HashMap;
use std::sync::Arc;

use arrow_schema::{DataType, Field, TimeUnit};

/// Key of a field's metadata: the unit, empty if the column has none.
pub const UNIT: &str = "unit";
/// Key of a field's metadata: what the column means. Spark and Delta show it as the column's comment.
pub const COMMENT: &str = "comment";
/// Name of the child of every list, as in the Parquet specification.
pub const LIST_CHILD: &str = "element";

/// A column before it is an Arrow field.
pub(super) struct Column {
    name: String,
    data_type: DataType,
    nullable: bool,
    unit: &'static str,
    comment: String,
}

impl Column {
    pub fn new(name: impl Into<String>, data_type: DataType, unit: &'static str, comment: impl Into<String>) -> Self {
        Self { name: name.into(), data_type, nullable: false, unit, comment: comment.into() }
    }

    pub fn text(name: &str, comment: &str) -> Self {
        Self::new(name, DataType::Utf8, "", comment)
    }

    pub fn flag(name: &str, comment: &str) -> Self {
        Self::new(name, DataType::Boolean, "", comment)
    }

    pub fn int(name: &str, unit: &'static str, comment: &str) -> Self {
        Self::new(name, DataType::Int32, unit, comment)
    }

    pub fn long(name: &str, unit: &'static str, comment: &str) -> Self {
        Self::new(name, DataType::Int64, unit, comment)
    }

    pub fn float(name: impl Into<String>, unit: &'static str, comment: impl Into<String>) -> Self {
        Self::new(name, DataType::Float32, unit, comment)
    }

    pub fn double(name: impl Into<String>, unit: &'static str, comment: impl Into<String>) -> Self {
        Self::new(name, DataType::Float64, unit, comment)
    }

    pub fn time(name: &str, comment: &str) -> Self {
        Self::new(name, DataType::Timestamp(TimeUnit::Microsecond, Some("UTC".into())), "", comment)
    }

    pub fn floats(name: impl Into<String>, unit: &'static str, comment: impl Into<String>) -> Self {
        let child = Field::new(LIST_CHILD, DataType::Float32, false);
        Self::new(name, DataType::List(Arc::new(child)), unit, comment)
    }

    pub fn or_null(mut self) -> Self {
        self.nullable = true;
        self
    }

    pub fn into_field(self) -> Field {
        let metadata = HashMap::from([(UNIT.to_owned(), self.unit.to_owned()), (COMMENT.to_owned(), self.comment)]);
        Field::new(self.name, self.data_type, self.nullable).with_metadata(metadata)
    }
}
