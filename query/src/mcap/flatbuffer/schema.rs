//! A binary schema of FlatBuffers (`.bfbs`), as `reflection.fbs` of FlatBuffers describes it, into the types of a message.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::datatypes::DataType;

use super::super::column::{DEEPEST, MOST_LEAVES};
use super::super::error::Malformed;
use super::buffer::{FlatbufferBytes, FlatbufferTable, OFFSET_BYTES};
use super::{Count, EnumNames, FlatbufferDefinition, Kind, Member};

/// Places of fields in the tables of `reflection.fbs`.
mod slot {
    pub(super) const SCHEMA_OBJECTS: u16 = 4;
    pub(super) const SCHEMA_ENUMS: u16 = 6;
    /// Of objects, fields, enums and their values.
    pub(super) const NAME: u16 = 4;
    pub(super) const OBJECT_FIELDS: u16 = 6;
    pub(super) const OBJECT_IS_STRUCT: u16 = 8;
    pub(super) const OBJECT_BYTES: u16 = 12;
    pub(super) const FIELD_TYPE: u16 = 6;
    pub(super) const FIELD_OFFSET: u16 = 10;
    pub(super) const FIELD_DEFAULT_INTEGER: u16 = 12;
    pub(super) const FIELD_DEFAULT_REAL: u16 = 14;
    pub(super) const FIELD_OPTIONAL: u16 = 26;
    pub(super) const FIELD_OFFSET_64: u16 = 30;
    pub(super) const TYPE_BASE: u16 = 4;
    pub(super) const TYPE_ELEMENT: u16 = 6;
    pub(super) const TYPE_INDEX: u16 = 8;
    pub(super) const TYPE_FIXED_LENGTH: u16 = 10;
    pub(super) const ENUM_VALUES: u16 = 6;
    pub(super) const VALUE_NUMBER: u16 = 6;
    pub(super) const VALUE_UNION_TYPE: u16 = 10;
}

/// Numbers of `BaseType` in `reflection.fbs`; 1 to 12 are numbers.
mod base {
    pub(super) const UNION_TYPE: u8 = 1;
    pub(super) const STRING: u8 = 13;
    pub(super) const VECTOR: u8 = 14;
    pub(super) const OBJECT: u8 = 15;
    pub(super) const UNION: u8 = 16;
    pub(super) const ARRAY: u8 = 17;
}

/// Foxglove's structs of seconds and nanoseconds.
const TIME: &str = "foxglove.Time";
const DURATION: &str = "foxglove.Duration";
const TIME_BYTES: usize = 8;
/// Most bytes of a schema's names.
const MOST_NAME_BYTES: usize = 16 << 20;

/// Reads the type of a message from a schema. The text of an error says what is wrong.
pub(super) fn parse(name: &str, data: &[u8]) -> Result<FlatbufferDefinition, String> {
    let root = FlatbufferBytes(data).root().map_err(damaged)?;
    let objects = root.children(slot::SCHEMA_OBJECTS).map_err(damaged)?;
    let enums = root.children(slot::SCHEMA_ENUMS).map_err(damaged)?;
    let is_named = |object: &FlatbufferTable<'_>| object.text(slot::NAME).is_ok_and(|own| own == name.as_bytes());
    let message = objects.iter().position(is_named);
    let message = message.ok_or_else(|| format!("its schema does not describe `{name}`"))?;
    let enum_names = HashMap::new();
    Parser { objects, enums, enum_names, within: Vec::new(), leaves: 0, name_bytes: 0 }.definition(message)
}

fn damaged(error: Malformed) -> String {
    format!("its schema is no binary schema of FlatBuffers: {error}")
}

struct Parser<'a> {
    objects: Vec<FlatbufferTable<'a>>,
    enums: Vec<FlatbufferTable<'a>>,
    enum_names: HashMap<usize, EnumNames>,
    /// The objects that the one at hand stands in.
    within: Vec<usize>,
    leaves: usize,
    /// Bytes of names and values so far: a schema can have the same ones in many places.
    name_bytes: usize,
}

impl<'a> Parser<'a> {
    fn name(&mut self, of: &FlatbufferTable<'_>) -> Result<String, String> {
        let name = of.text(slot::NAME).map_err(damaged)?;
        self.spend(name.len())?;
        Ok(String::from_utf8_lossy(name).into_owned())
    }

    fn spend(&mut self, bytes: usize) -> Result<(), String> {
        self.name_bytes = self.name_bytes.saturating_add(bytes);
        match self.name_bytes > MOST_NAME_BYTES {
            true => Err(format!("its schema has more than {} MiB of names", MOST_NAME_BYTES >> 20)),
            false => Ok(()),
        }
    }

    fn definition(&mut self, index: usize) -> Result<FlatbufferDefinition, String> {
        let object = *self.objects.get(index).ok_or_else(|| format!("its schema has no object {index}"))?;
        let name = self.name(&object)?;
        if self.within.contains(&index) || self.within.len() >= DEEPEST {
            return Err(format!("`{name}` stands within itself, or more than {DEEPEST} deep"));
        }
        self.within.push(index);
        let fields = object.children(slot::OBJECT_FIELDS).map_err(damaged)?;
        let mut members = fields.iter().map(|f| self.member(f)).collect::<Result<Vec<_>, _>>()?;
        self.within.pop();
        members.sort_by_key(|member| member.slot);
        let is_struct = object.number(slot::OBJECT_IS_STRUCT).map_err(damaged)? == Some([1]);
        let bytes = object.number(slot::OBJECT_BYTES).map_err(damaged)?.map_or(0, i32::from_le_bytes);
        Ok(FlatbufferDefinition { name, members, is_struct, bytes: usize::try_from(bytes).unwrap_or(0) })
    }

    fn member(&mut self, field: &FlatbufferTable<'_>) -> Result<Member, String> {
        let name = self.name(field)?;
        let kind = field.child(slot::FIELD_TYPE).map_err(damaged)?;
        let kind = kind.ok_or_else(|| format!("its field `{name}` has no type"))?;
        let flag = |slot| field.number(slot).map(|flag| flag == Some([1]));
        if flag(slot::FIELD_OFFSET_64).map_err(damaged)? {
            return Err(format!("its field `{name}` has an offset of 64 bits"));
        }
        let number = |slot, number: u8| Ok::<_, Malformed>(kind.number(slot)?.map_or(number, |[number]| number));
        let (base, element) = (number(slot::TYPE_BASE, 0), number(slot::TYPE_ELEMENT, 0));
        let (base, element) = (base.map_err(damaged)?, element.map_err(damaged)?);
        let index = kind.number(slot::TYPE_INDEX).map_err(damaged)?.map_or(-1, i32::from_le_bytes);
        let fixed = kind.number(slot::TYPE_FIXED_LENGTH).map_err(damaged)?.map_or(0, u16::from_le_bytes);
        let (base, count) = match base {
            base::VECTOR => (element, Count::Vector),
            base::ARRAY => (element, Count::Fixed(usize::from(fixed))),
            _ => (base, Count::One),
        };
        let kind = self.kind(base, index, &name)?;
        if count != Count::One && matches!(kind, Kind::Union(_)) {
            return Err(format!("its field `{name}` is a vector of unions"));
        }
        Ok(Member {
            slot: field.number(slot::FIELD_OFFSET).map_err(damaged)?.map_or(0, u16::from_le_bytes),
            integer: field.number(slot::FIELD_DEFAULT_INTEGER).map_err(damaged)?.map_or(0, i64::from_le_bytes),
            real: field.number(slot::FIELD_DEFAULT_REAL).map_err(damaged)?.map_or(0.0, f64::from_le_bytes),
            is_optional: flag(slot::FIELD_OPTIONAL).map_err(damaged)?,
            name,
            kind,
            count,
        })
    }

    fn kind(&mut self, base: u8, index: i32, field: &str) -> Result<Kind, String> {
        self.leaves += 1;
        if self.leaves > MOST_LEAVES {
            return Err(format!("its schema has more than {MOST_LEAVES} columns"));
        }
        let index = usize::try_from(index).ok();
        match (base, index) {
            (base::STRING, _) => Ok(Kind::Text),
            (base::OBJECT, Some(index)) => {
                let definition = self.definition(index)?;
                Ok(match definition.name.as_str() {
                    TIME if definition.is_inline(TIME_BYTES) => Kind::Time,
                    DURATION if definition.is_inline(TIME_BYTES) => Kind::Duration,
                    _ => Kind::Object(definition),
                })
            }
            (base::UNION, Some(index)) => Ok(Kind::Union(self.union(index)?)),
            _ => {
                let number = number_type(base)
                    .ok_or_else(|| format!("its field `{field}` has a type that is not known: {base}"))?;
                Ok(match index {
                    Some(index) => Kind::Enum(number, self.names(index)?),
                    None => Kind::Number(number),
                })
            }
        }
    }

    fn values(&mut self, index: usize) -> Result<Vec<FlatbufferTable<'a>>, String> {
        let found = self.enums.get(index).ok_or_else(|| format!("its schema has no enum {index}"))?;
        let values = found.children(slot::ENUM_VALUES).map_err(damaged)?;
        self.spend(values.len() * size_of::<FlatbufferTable<'_>>())?;
        Ok(values)
    }

    fn names(&mut self, index: usize) -> Result<EnumNames, String> {
        if let Some(known) = self.enum_names.get(&index) {
            return Ok(known.clone());
        }
        let mut names = HashMap::new();
        // Of several names of a number the first counts.
        for value in self.values(index)?.iter().rev() {
            names.insert(value_number(value).map_err(damaged)?, self.name(value)?);
        }
        let names = Arc::new(names);
        self.enum_names.insert(index, names.clone());
        Ok(names)
    }

    fn union(&mut self, index: usize) -> Result<Vec<(i64, Member)>, String> {
        let mut parts = Vec::new();
        for value in self.values(index)? {
            let Some(kind) = value.child(slot::VALUE_UNION_TYPE).map_err(damaged)? else { continue };
            let base = kind.number(slot::TYPE_BASE).map_err(damaged)?.map_or(0, |[base]| base);
            let at = kind.number(slot::TYPE_INDEX).map_err(damaged)?.map_or(-1, i32::from_le_bytes);
            let name = self.name(&value)?;
            // NONE is no value.
            if base != 0 {
                parts.push((value_number(&value).map_err(damaged)?, base, at, name));
            }
        }
        let part = |(number, base, at, name): (i64, u8, i32, String)| {
            Ok((number, Member::alone(self.kind(base, at, &name)?, name)))
        };
        parts.into_iter().map(part).collect()
    }
}

fn value_number(value: &FlatbufferTable<'_>) -> Result<i64, Malformed> {
    Ok(value.number(slot::VALUE_NUMBER)?.map_or(0, i64::from_le_bytes))
}

fn number_type(base: u8) -> Option<DataType> {
    Some(match base {
        2 => DataType::Boolean,
        3 => DataType::Int8,
        base::UNION_TYPE | 4 => DataType::UInt8,
        5 => DataType::Int16,
        6 => DataType::UInt16,
        7 => DataType::Int32,
        8 => DataType::UInt32,
        9 => DataType::Int64,
        10 => DataType::UInt64,
        11 => DataType::Float32,
        12 => DataType::Float64,
        _ => return None,
    })
}

impl FlatbufferDefinition {
    fn is_inline(&self, bytes: usize) -> bool {
        self.is_struct && self.bytes == bytes
    }

    /// Bytes of an element of a vector.
    pub(super) fn element_bytes(&self) -> usize {
        if self.is_struct { self.bytes } else { OFFSET_BYTES }
    }
}
