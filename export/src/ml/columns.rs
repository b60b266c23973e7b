//! The columns of a training set: its keys, and the columns chosen from the lake's tables.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::datatypes::{DataType, Field, FieldRef, Schema, SchemaRef};
use echolake_schema::Rig;
use echolake_schema::tables::{COMMENT, LIST_CHILD, Table, UNIT};

use crate::error::{Error, Result};

/// Tables whose columns can be chosen; the first one that has a name provides the column.
const TABLES: [Table; 3] = [Table::Measurements, Table::Nce, Table::Tnce];
/// Key of a response's sampling rate in its column's metadata.
const RATE_HZ: &str = "rate_hz";
/// Columns that are keys here already, or repeat `surfaces.csv`.
const NOT_CHOSEN: [&str; 10] = [
    "surface_id",
    "run_id",
    "pair_id",
    "microphone",
    "speaker",
    "log_time",
    "chunk_offset",
    "flat_version",
    "foam_version",
    "code_version",
];

/// The chosen columns, by the table that they come from.
#[derive(Debug, Clone)]
pub(super) struct TrainingColumns {
    /// In the order of the training set.
    chosen: Vec<(Table, FieldRef)>,
    schema: SchemaRef,
}

/// The default columns: the response, its temperature and quality, and TNCE.
fn default_columns(rig: &Rig) -> Vec<String> {
    let mut names: Vec<String> = ["temperature_c", "snr_db", "ir"].map(str::to_owned).into();
    names.extend(rig.band_names().iter().map(|band| format!("tnce_{band}")));
    names.push("tnce_total".to_owned());
    names
}

impl TrainingColumns {
    /// Chooses the columns of these names; the defaults if there are no names.
    pub fn choose(rig: &Rig, names: &[String]) -> Result<Self> {
        let tables: Vec<_> = TABLES.into_iter().map(|table| (table, table.schema(rig))).collect();
        let usual = default_columns(rig);
        let mut chosen: Vec<(Table, FieldRef)> = Vec::new();
        for name in if names.is_empty() { &usual } else { names } {
            let found = tables.iter().find_map(|(table, schema)| Some((*table, schema.field_with_name(name).ok()?)));
            let found = found.filter(|_| !NOT_CHOSEN.contains(&name.as_str()));
            let (table, field) = found.ok_or_else(|| unknown_column(name, &tables))?;
            if chosen.iter().all(|(_, f)| f.name() != name) {
                chosen.push((table, Arc::new(narrowed_field(field, rig)?)));
            }
        }
        let mut fields = key_fields();
        fields.extend(chosen.iter().map(|(_, field)| field.clone()));
        Ok(Self { chosen, schema: Arc::new(Schema::new(fields)) })
    }

    /// The schema of the training set.
    pub fn schema(&self) -> &SchemaRef {
        &self.schema
    }

    /// The chosen columns of a table.
    pub fn of_table(&self, table: Table) -> Vec<&str> {
        self.chosen.iter().filter(|(from, _)| *from == table).map(|(_, field)| field.name().as_str()).collect()
    }

    /// Every chosen column with its table, in order.
    pub fn chosen(&self) -> &[(Table, FieldRef)] {
        &self.chosen
    }
}

fn unknown_column(name: &str, tables: &[(Table, SchemaRef)]) -> Error {
    let mut known: Vec<String> = Vec::new();
    for field in tables.iter().flat_map(|(_, schema)| schema.fields()) {
        if !NOT_CHOSEN.contains(&field.name().as_str()) && !known.contains(field.name()) {
            known.push(field.name().clone());
        }
    }
    Error::Unknown { kind: "column", name: name.to_owned(), known: known.join(", ") }
}

// Numbers in single precision, as networks take them; lists of the rig's fixed length, with their rate.
fn narrowed_field(field: &Field, rig: &Rig) -> Result<Field> {
    let mut narrowed = field.clone();
    match field.data_type() {
        DataType::Float64 => narrowed.set_data_type(DataType::Float32),
        DataType::List(_) => {
            narrowed.set_data_type(list_type(rig.impulse_response.length)?);
            narrowed.metadata_mut().insert(RATE_HZ.to_owned(), rig.sweep.rate_hz.get().to_string());
        }
        _ => {}
    }
    Ok(narrowed)
}

/// Returns the type of a list of `length` f32.
pub(super) fn list_type(length: usize) -> Result<DataType> {
    let length = i32::try_from(length).map_err(|e| Error::damaged("lake.toml", e))?;
    Ok(DataType::FixedSizeList(Arc::new(Field::new(LIST_CHILD, DataType::Float32, false)), length))
}

/// Returns a field with its unit and meaning as metadata.
pub(super) fn described_field(name: &str, data_type: DataType, unit: &str, comment: &str) -> FieldRef {
    let metadata = HashMap::from([(UNIT.to_owned(), unit.to_owned()), (COMMENT.to_owned(), comment.to_owned())]);
    Arc::new(Field::new(name, data_type, name == "macrostructure").with_metadata(metadata))
}

fn key_fields() -> Vec<FieldRef> {
    let position = DataType::FixedSizeList(Arc::new(Field::new(LIST_CHILD, DataType::Float32, false)), 3);
    vec![
        described_field("surface_id", DataType::Utf8, "", "The measured surface, as 0015_0"),
        described_field("run_id", DataType::Utf8, "", "The run that it was measured in"),
        described_field(
            "symmetry",
            DataType::Utf8,
            "",
            "What the row is turned by: identity, rot90, rot180, rot270, mirror_x, mirror_y, mirror_diag or \
             mirror_anti",
        ),
        described_field("split", DataType::Utf8, "", "train, validation or test"),
        described_field(
            "group",
            DataType::Utf8,
            "",
            "Physical panel: all of its sides, runs and symmetries are in one split",
        ),
        described_field("typology", DataType::Utf8, "", "Kind of relief"),
        described_field(
            "macrostructure",
            DataType::Utf8,
            "",
            "The large shape beneath the relief; null where there is none",
        ),
        described_field("pair_id", DataType::Int32, "", "The measured pair that the numbers come from"),
        described_field("microphone", DataType::Int32, "", "Grid point of the microphone, after the symmetry"),
        described_field("speaker", DataType::Int32, "", "Grid point of the speaker, after the symmetry"),
        described_field(
            "swapped",
            DataType::Boolean,
            "",
            "The symmetry made microphone and speaker change places: the row relies on reciprocity",
        ),
        described_field(
            "microphone_mm",
            position.clone(),
            "mm",
            "x, y, z of the microphone, after the symmetry; origin at the panel's centre",
        ),
        described_field("speaker_mm", position, "mm", "x, y, z of the speaker, after the symmetry"),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_chosen_by_name_and_unknown_ones_are_named() {
        let rig = Rig::paper();
        let usual = TrainingColumns::choose(&rig, &[]).expect("the usual");
        assert_eq!(usual.of_table(Table::Tnce).len(), 6);
        let length = |name: &str| usual.schema().field_with_name(name).map(|f| f.data_type().clone()).expect(name);
        assert_eq!(length("ir"), list_type(384).expect("a list"));
        assert_eq!(usual.schema().field_with_name("ir").expect("ir").metadata()[RATE_HZ], "96000");
        let some =
            TrainingColumns::choose(&rig, &["nce_2500".into(), "tnce_total".into(), "nce_2500".into()]).expect("some");
        assert_eq!(some.chosen().len(), 2);
        for bad in ["nope", "code_version", "surface_id"] {
            let error = TrainingColumns::choose(&rig, &[bad.to_owned()]).expect_err(bad).to_string();
            assert!(error.contains("reflected_ir, nce_2500"), "{error}");
        }
    }
}
