//! The decoder against reflection's own messages, over random ones of every kind of field, whole, merged and damaged.

use arrow::array::{Array, ArrayRef, AsArray as _};
use arrow::datatypes::{
    DurationNanosecondType, Float32Type, Float64Type, Int32Type, Int64Type, TimestampNanosecondType, UInt32Type,
    UInt64Type,
};
use prost_reflect::prost::Message as _;
use prost_reflect::prost_types::field_descriptor_proto::{Label as ProtoLabel, Type};
use prost_reflect::prost_types::{
    DescriptorProto, EnumDescriptorProto, EnumOptions, EnumValueDescriptorProto, FieldDescriptorProto, FieldOptions,
    FileDescriptorProto, FileDescriptorSet, MessageOptions, OneofDescriptorProto,
};
use prost_reflect::{DynamicMessage, MapKey, ReflectMessage as _, Value};

use super::*;
use crate::encodings::{Malformed, MessageLayout, RowDecoder};

/// A linear congruential generator: Knuth, MMIX.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        self.0 >> 11
    }

    fn below(&mut self, most: u64) -> u64 {
        self.next() % most
    }

    // Small numbers, large ones and those with the sign set.
    fn number(&mut self) -> u64 {
        let bits = self.below(65);
        if bits == 0 { 0 } else { (self.next() << 40 ^ self.next() << 20 ^ self.next()) >> (64 - bits) }
    }
}

const SCALARS: [(&str, Type); 15] = [
    ("double", Type::Double),
    ("float", Type::Float),
    ("int64", Type::Int64),
    ("uint64", Type::Uint64),
    ("int32", Type::Int32),
    ("fixed64", Type::Fixed64),
    ("fixed32", Type::Fixed32),
    ("bool", Type::Bool),
    ("string", Type::String),
    ("bytes", Type::Bytes),
    ("uint32", Type::Uint32),
    ("sfixed32", Type::Sfixed32),
    ("sfixed64", Type::Sfixed64),
    ("sint32", Type::Sint32),
    ("sint64", Type::Sint64),
];

fn field<'a>(
    message: &'a mut DescriptorProto,
    name: &str,
    kind: Type,
    label: ProtoLabel,
) -> &'a mut FieldDescriptorProto {
    // A number beyond the small ones, now and then.
    let count = message.field.len() as i32;
    let number = if count % 17 == 16 { 2000 + count } else { count + 1 };
    message.field.push(FieldDescriptorProto {
        name: Some(name.to_owned()),
        number: Some(number),
        label: Some(label.into()),
        r#type: Some(kind.into()),
        ..Default::default()
    });
    message.field.last_mut().expect("just added")
}

fn map(message: &mut DescriptorProto, name: &str, key: Type, value: (Type, Option<&str>)) {
    let entry_name = format!("{}Entry", name[..1].to_uppercase() + &name[1..]);
    let mut entry = DescriptorProto {
        name: Some(entry_name.clone()),
        options: Some(MessageOptions { map_entry: Some(true), ..Default::default() }),
        ..Default::default()
    };
    field(&mut entry, "key", key, ProtoLabel::Optional);
    field(&mut entry, "value", value.0, ProtoLabel::Optional).type_name = value.1.map(str::to_owned);
    message.nested_type.push(entry);
    field(message, name, Type::Message, ProtoLabel::Repeated).type_name = Some(format!(".t.All.{entry_name}"));
}

/// A message type with fields of every kind, and Google's own time types.
fn all() -> MessageDescriptor {
    let mut inner = DescriptorProto { name: Some("Inner".into()), ..Default::default() };
    field(&mut inner, "a", Type::Int32, ProtoLabel::Optional);
    field(&mut inner, "b", Type::String, ProtoLabel::Optional);
    field(&mut inner, "f", Type::Float, ProtoLabel::Repeated);
    field(&mut inner, "again", Type::Message, ProtoLabel::Optional).type_name = Some(".t.Inner".into());
    let empty = DescriptorProto { name: Some("Empty".into()), ..Default::default() };
    let mut all = DescriptorProto { name: Some("All".into()), ..Default::default() };
    for (i, (name, kind)) in SCALARS.into_iter().enumerate() {
        field(&mut all, &format!("s_{name}"), kind, ProtoLabel::Optional);
        let optional = field(&mut all, &format!("o_{name}"), kind, ProtoLabel::Optional);
        (optional.proto3_optional, optional.oneof_index) = (Some(true), Some(i as i32 + 1));
        field(&mut all, &format!("r_{name}"), kind, ProtoLabel::Repeated);
        let loose = field(&mut all, &format!("u_{name}"), kind, ProtoLabel::Repeated);
        if !matches!(kind, Type::String | Type::Bytes) {
            loose.options = Some(FieldOptions { packed: Some(false), ..Default::default() });
        }
    }
    for (name, kind, of) in [
        ("e", Type::Enum, ".t.Colour"),
        ("m", Type::Message, ".t.Inner"),
        ("none", Type::Message, ".t.Empty"),
        ("t", Type::Message, ".google.protobuf.Timestamp"),
        ("d", Type::Message, ".google.protobuf.Duration"),
        ("again", Type::Message, ".t.All"),
    ] {
        field(&mut all, &format!("s_{name}"), kind, ProtoLabel::Optional).type_name = Some(of.into());
        field(&mut all, &format!("r_{name}"), kind, ProtoLabel::Repeated).type_name = Some(of.into());
    }
    map(&mut all, "texts", Type::Int32, (Type::String, None));
    map(&mut all, "numbers", Type::String, (Type::Double, None));
    map(&mut all, "inners", Type::Sint64, (Type::Message, Some(".t.Inner")));
    map(&mut all, "colours", Type::Bool, (Type::Enum, Some(".t.Colour")));
    for (name, kind, of) in
        [("x", Type::Sint32, None), ("y", Type::String, None), ("z", Type::Message, Some(".t.Inner"))]
    {
        let one = field(&mut all, name, kind, ProtoLabel::Optional);
        (one.oneof_index, one.type_name) = (Some(0), of.map(str::to_owned));
    }
    let names = std::iter::once("choice".to_owned()).chain(SCALARS.iter().map(|(name, _)| format!("_o_{name}")));
    all.oneof_decl = names.map(|name| OneofDescriptorProto { name: Some(name), ..Default::default() }).collect();
    let values = [("RED", 0), ("GREEN", 1), ("BLUE", -5)].map(|(name, number)| EnumValueDescriptorProto {
        name: Some(name.into()),
        number: Some(number),
        ..Default::default()
    });
    let colour = EnumDescriptorProto { name: Some("Colour".into()), value: values.to_vec(), ..Default::default() };
    let file = FileDescriptorProto {
        name: Some("t.proto".into()),
        package: Some("t".into()),
        syntax: Some("proto3".into()),
        dependency: vec!["google/protobuf/timestamp.proto".into(), "google/protobuf/duration.proto".into()],
        message_type: vec![inner, empty, all],
        enum_type: vec![colour],
        ..Default::default()
    };
    let mut set: Vec<FileDescriptorProto> = DescriptorPool::global().file_descriptor_protos().cloned().collect();
    set.retain(|f| f.name().ends_with("timestamp.proto") || f.name().ends_with("duration.proto"));
    set.push(file);
    message_type("t.All", &FileDescriptorSet { file: set }.encode_to_vec()).expect("a message type")
}

fn random_value(kind: &ProtoKind, random: &mut Random, depth: usize) -> Value {
    let number = random.number();
    match kind {
        ProtoKind::Double => Value::F64(f64::from_bits(number)),
        ProtoKind::Float => Value::F32(f32::from_bits(number as u32)),
        ProtoKind::Int32 | ProtoKind::Sint32 | ProtoKind::Sfixed32 => Value::I32(number as i32),
        ProtoKind::Int64 | ProtoKind::Sint64 | ProtoKind::Sfixed64 => Value::I64(number as i64),
        ProtoKind::Uint32 | ProtoKind::Fixed32 => Value::U32(number as u32),
        ProtoKind::Uint64 | ProtoKind::Fixed64 => Value::U64(number),
        ProtoKind::Bool => Value::Bool(number % 2 == 1),
        ProtoKind::String => Value::String("äx".repeat(random.below(5) as usize)),
        ProtoKind::Bytes => Value::Bytes(number.to_le_bytes()[..random.below(9) as usize].to_vec().into()),
        ProtoKind::Enum(_) => Value::EnumNumber([0, 1, -5, 77][random.below(4) as usize]),
        ProtoKind::Message(message) => Value::Message(random_message(message, random, depth + 1)),
    }
}

fn random_message(descriptor: &MessageDescriptor, random: &mut Random, depth: usize) -> DynamicMessage {
    let mut message = DynamicMessage::new(descriptor.clone());
    for field in descriptor.fields() {
        if random.below(10) < 4 + 2 * depth as u64 {
            continue;
        }
        let kind = field.kind();
        let value = if let (true, Some(entry)) = (field.is_map(), kind.as_message()) {
            let one = |random: &mut Random| {
                let key = random_value(&entry.map_entry_key_field().kind(), random, depth);
                let key = match key {
                    Value::I32(n) => MapKey::I32(n % 4),
                    Value::I64(n) => MapKey::I64(n % 4),
                    Value::Bool(b) => MapKey::Bool(b),
                    Value::String(s) => MapKey::String(s),
                    other => panic!("{other:?} is no key"),
                };
                (key, random_value(&entry.map_entry_value_field().kind(), random, depth))
            };
            Value::Map((0..random.below(4)).map(|_| one(random)).collect())
        } else if field.is_list() {
            Value::List((0..random.below(5)).map(|_| random_value(&kind, random, depth)).collect())
        } else {
            random_value(&kind, random, depth)
        };
        message.set_field(&field, value);
    }
    message
}

fn same_field(field: &FieldDescriptor, message: &DynamicMessage, array: &ArrayRef, row: usize) {
    let name = field.full_name();
    let value = message.get_field(field);
    match value.as_ref() {
        Value::Map(expected) => {
            let entries = array.as_map().value(row);
            assert_eq!(entries.len(), expected.len(), "{name}");
            let Some(entry) = field.kind().as_message().cloned() else { panic!("{name} is a map without entries") };
            for i in 0..entries.len() {
                let keys = entries.column(0);
                let key = match entry.map_entry_key_field().kind() {
                    ProtoKind::Int32 => MapKey::I32(keys.as_primitive::<Int32Type>().value(i)),
                    ProtoKind::Sint64 => MapKey::I64(keys.as_primitive::<Int64Type>().value(i)),
                    ProtoKind::Bool => MapKey::Bool(keys.as_boolean().value(i)),
                    _ => MapKey::String(keys.as_string::<i32>().value(i).to_owned()),
                };
                same_value(name, &expected[&key], entries.column(1), i);
            }
        }
        Value::List(expected) => {
            let values = array.as_list::<i32>().value(row);
            assert_eq!(values.len(), expected.len(), "{name}");
            expected.iter().enumerate().for_each(|(i, value)| same_value(name, value, &values, i));
        }
        _ if field.supports_presence() && !message.has_field(field) => assert!(array.is_null(row), "{name}"),
        value => same_value(name, value, array, row),
    }
}

fn same_value(name: &str, value: &Value, array: &ArrayRef, row: usize) {
    let overflows = matches!(value, Value::Message(m) if time(m).is_some_and(|nanos| nanos.is_none()));
    assert_eq!(array.is_null(row), overflows, "{name}");
    match value {
        Value::Bool(v) => assert_eq!(array.as_boolean().value(row), *v, "{name}"),
        Value::I32(v) => assert_eq!(array.as_primitive::<Int32Type>().value(row), *v, "{name}"),
        Value::I64(v) => assert_eq!(array.as_primitive::<Int64Type>().value(row), *v, "{name}"),
        Value::U32(v) => assert_eq!(array.as_primitive::<UInt32Type>().value(row), *v, "{name}"),
        Value::U64(v) => assert_eq!(array.as_primitive::<UInt64Type>().value(row), *v, "{name}"),
        // All NaNs become one.
        Value::F32(v) => {
            let v = if v.is_nan() { f32::NAN } else { *v };
            assert_eq!(array.as_primitive::<Float32Type>().value(row).to_bits(), v.to_bits(), "{name}");
        }
        Value::F64(v) => {
            let v = if v.is_nan() { f64::NAN } else { *v };
            assert_eq!(array.as_primitive::<Float64Type>().value(row).to_bits(), v.to_bits(), "{name}");
        }
        Value::String(v) => assert_eq!(array.as_string::<i32>().value(row), v, "{name}"),
        Value::Bytes(v) => assert_eq!(array.as_binary::<i32>().value(row), v, "{name}"),
        Value::EnumNumber(v) => {
            let shown = match v {
                0 => "RED".to_owned(),
                1 => "GREEN".to_owned(),
                -5 => "BLUE".to_owned(),
                other => other.to_string(),
            };
            assert_eq!(array.as_string::<i32>().value(row), shown, "{name}");
        }
        Value::Message(v) => same_message(name, v, array, row),
        other => panic!("{name}: {other:?}"),
    }
}

// None where it is no time, Some(None) where 64 bits do not hold it.
fn time(message: &DynamicMessage) -> Option<Option<i64>> {
    matches!(message.descriptor().full_name(), "google.protobuf.Timestamp" | "google.protobuf.Duration").then(|| {
        let of = |name: &str| message.get_field_by_name(name).expect("a field").into_owned();
        let (Value::I64(seconds), Value::I32(nanos)) = (of("seconds"), of("nanos")) else { panic!("no time") };
        seconds.checked_mul(1_000_000_000)?.checked_add(i64::from(nanos))
    })
}

fn same_message(name: &str, message: &DynamicMessage, array: &ArrayRef, row: usize) {
    match array.data_type() {
        DataType::Timestamp(..) => {
            let value = array.as_primitive::<TimestampNanosecondType>();
            assert_eq!(array.is_valid(row).then(|| value.value(row)), time(message).flatten(), "{name}");
        }
        DataType::Duration(_) => {
            let value = array.as_primitive::<DurationNanosecondType>();
            assert_eq!(array.is_valid(row).then(|| value.value(row)), time(message).flatten(), "{name}");
        }
        DataType::Binary => {
            let bytes = array.as_binary::<i32>().value(row);
            let again = DynamicMessage::decode(message.descriptor(), bytes).expect("a message");
            // Compared as they are encoded: NaN is not equal to itself. Maps have no order, so those are left out.
            assert_eq!(again.encoded_len(), message.encoded_len(), "{name}");
        }
        DataType::Boolean => assert!(array.as_boolean().value(row), "{name}"),
        _ => {
            let columns = array.as_struct();
            for (i, field) in message.descriptor().fields().enumerate() {
                same_field(&field, message, columns.column(i), row);
            }
        }
    }
}

fn layout(descriptor: &MessageDescriptor) -> MessageLayout {
    let fields = message_columns(descriptor).expect("columns");
    MessageLayout { fields, message_type: Some(Box::new(descriptor.clone())) }
}

fn decoder(descriptor: &MessageDescriptor) -> RowDecoder {
    let layout = layout(descriptor);
    let all: Vec<_> = (0..layout.fields.len()).collect();
    layout.create_decoder(&all)
}

fn finish(decoder: &mut RowDecoder) -> Vec<ArrayRef> {
    decoder.finish().expect("arrays")
}

#[test]
fn random_messages_are_decoded_as_reflection_does() {
    let descriptor = all();
    let mut random = Random(11);
    let mut decoder = decoder(&descriptor);
    let mut expected = Vec::new();
    for _ in 0..600 {
        let mut bytes = random_message(&descriptor, &mut random, 0).encode_to_vec();
        if random.below(3) == 0 {
            // Two messages behind each other are one, merged.
            bytes.extend(random_message(&descriptor, &mut random, 0).encode_to_vec());
        }
        if random.below(3) == 0 {
            // Fields that nobody knows: a number, bytes, and a group with a number in it.
            bytes.extend([0xC0, 0xBB, 0x01, 0x05, 0xC2, 0xBB, 0x01, 0x02, 0x61, 0x62]);
            bytes.extend([0xC3, 0xBB, 0x01, 0x08, 0x07, 0xC4, 0xBB, 0x01]);
        }
        expected.push(DynamicMessage::decode(descriptor.clone(), bytes.as_slice()).expect("a message"));
        decoder.push_message(&bytes).expect("decoded");
    }
    let arrays = finish(&mut decoder);
    for (row, message) in expected.iter().enumerate() {
        for (field, array) in descriptor.fields().zip(&arrays) {
            assert_eq!(array.len(), expected.len(), "{}", field.full_name());
            same_field(&field, message, array, row);
        }
    }
}

#[test]
fn some_columns_are_those_of_all() {
    let descriptor = all();
    let layout = layout(&descriptor);
    let mut random = Random(3);
    let messages: Vec<_> = (0..40).map(|_| random_message(&descriptor, &mut random, 0).encode_to_vec()).collect();
    let mut whole = decoder(&descriptor);
    messages.iter().for_each(|m| whole.push_message(m).expect("decoded"));
    let whole = finish(&mut whole);
    for wanted in [vec![], vec![3], vec![70, 2, 61]] {
        let mut some = layout.create_decoder(&wanted);
        messages.iter().for_each(|m| some.push_message(m).expect("decoded"));
        let some = finish(&mut some);
        assert_eq!(some.len(), wanted.len());
        wanted.iter().zip(&some).for_each(|(i, array)| assert_eq!(array, &whole[*i], "{}", layout.fields[*i].name()));
    }
}

#[test]
fn a_message_within_itself_is_its_bytes() {
    let fields = message_columns(&all()).expect("columns");
    let kind = |name: &str| fields.find(name).map(|(_, f)| f.data_type().clone());
    assert_eq!(kind("s_again"), Some(DataType::Binary));
    let Some(DataType::Struct(inner)) = kind("s_m") else { panic!("no struct") };
    assert_eq!(inner.find("again").map(|(_, f)| f.data_type()), Some(&DataType::Binary));
}

// A file descriptor of message `M` with an int32 `a`, a message `m` and an enum `e`, in any syntax; then raw bytes that
// the library's types lack.
fn set_of(syntax: &str, field_features: &[u8], file_features: &[u8], names: &[(&str, i32)]) -> Vec<u8> {
    fn delimited(tag: u8, bytes: &[u8]) -> Vec<u8> {
        let mut field = vec![tag << 3 | 2];
        prost::encoding::encode_varint(bytes.len() as u64, &mut field);
        field.extend_from_slice(bytes);
        field
    }
    let mut message = DescriptorProto { name: Some("M".into()), ..Default::default() };
    field(&mut message, "m", Type::Message, ProtoLabel::Optional).type_name = Some(".M".into());
    field(&mut message, "e", Type::Enum, ProtoLabel::Optional).type_name = Some(".E".into());
    let mut other = DescriptorProto::default();
    field(&mut other, "a", Type::Int32, ProtoLabel::Optional).number = Some(7);
    let a = [other.field[0].encode_to_vec().as_slice(), field_features].concat();
    let message = [message.encode_to_vec(), delimited(2, &a)].concat();
    let value = |(name, number): &(&str, i32)| EnumValueDescriptorProto {
        name: Some((*name).into()),
        number: Some(*number),
        ..Default::default()
    };
    let names = EnumDescriptorProto {
        name: Some("E".into()),
        value: names.iter().map(value).collect(),
        options: Some(EnumOptions { allow_alias: Some(true), ..Default::default() }),
        ..Default::default()
    };
    let file = FileDescriptorProto {
        name: Some("m.proto".into()),
        syntax: Some(syntax.into()),
        enum_type: vec![names],
        ..Default::default()
    };
    let file = [file.encode_to_vec().as_slice(), &delimited(4, &message), file_features].concat();
    delimited(1, &file)
}

/// `edition = "2023"`.
const EDITION_2023: [u8; 3] = [14 << 3, 0xE8, 0x07];
/// Options of a file and of a field with `features.field_presence = IMPLICIT`.
const IMPLICIT_FILE: [u8; 6] = [8 << 3 | 2, 5, 0x92, 0x03, 2, 1 << 3];
const NAMES: [(&str, i32); 4] = [("UP", 1), ("NONE", 0), ("ALSO_UP", 1), ("NOTHING", 0)];

#[test]
fn an_edition_is_read_by_its_presence() {
    let implicit_field = [8 << 3 | 2, 5, 0xAA, 0x01, 2, 1 << 3, 2];
    let implicit_file = [&EDITION_2023[..], &IMPLICIT_FILE, &[2]].concat();
    let explicit_field = [8 << 3 | 2, 5, 0xAA, 0x01, 2, 1 << 3, 1];
    for (field_features, file_features, expected) in [
        (&[][..], &EDITION_2023[..], None),
        (&implicit_field, &EDITION_2023, Some(0)),
        (&[], &implicit_file, Some(0)),
        (&explicit_field, &implicit_file, None),
    ] {
        let set = set_of("editions", field_features, file_features, &NAMES);
        let message = message_type("M", &set).expect("a message type");
        let names: Vec<_> = message_columns(&message).expect("columns").iter().map(|f| f.name().clone()).collect();
        assert_eq!(names, ["m", "e", "a"]);
        let mut decoder = decoder(&message);
        // An empty one, then a = 5 and e = 1.
        decoder.push_message(&[]).expect("decoded");
        decoder.push_message(&[7 << 3, 5, 2 << 3, 1]).expect("decoded");
        let columns = finish(&mut decoder);
        let numbers = columns[2].as_primitive::<Int32Type>();
        assert_eq!((numbers.iter().next().flatten(), numbers.value(1)), (expected, 5), "{field_features:?}");
        assert_eq!(columns[1].as_string::<i32>().value(1), "UP");
    }
}

#[test]
fn a_syntax_that_is_not_known_is_refused() {
    for (syntax, features, expected) in [
        ("proto4", &[][..], "is in `proto4`"),
        ("editions", &[], "is of edition 0"),
        ("editions", &[14 << 3, 0xEF, 0x07], "is of edition 1007"),
    ] {
        let error = message_type("M", &set_of(syntax, &[], features, &NAMES)).map(drop).expect_err(syntax);
        assert!(error.contains(expected), "{error}");
    }
    // As some writers say proto2.
    message_type("M", &set_of("", &[], &[], &NAMES)).expect("a message type");
}

#[test]
fn of_several_names_the_first_is_shown() {
    for (syntax, names) in [("proto2", NAMES), ("proto3", [NAMES[1], NAMES[0], NAMES[3], NAMES[2]])] {
        let message = message_type("M", &set_of(syntax, &[], &[], &names)).expect("a message type");
        let mut decoder = decoder(&message);
        decoder.push_message(&[2 << 3, 1]).expect("decoded");
        decoder.push_message(&[2 << 3, 0]).expect("decoded");
        let columns = finish(&mut decoder);
        let shown: Vec<_> = columns[1].as_string::<i32>().iter().flatten().collect();
        assert_eq!(shown, ["UP", "NONE"], "{syntax}");
    }
}

#[test]
fn damaged_descriptors_are_refused_or_read() {
    let mut random = Random(5);
    let (mut refused, mut read) = (0, 0);
    for set in [set_of("proto3", &[], &[], &NAMES[1..]), set_of("editions", &[], &EDITION_2023, &NAMES)] {
        for _ in 0..2000 {
            let mut set = set.clone();
            let at = random.below(set.len() as u64) as usize;
            set[at] ^= 1 << random.below(8);
            match message_type("M", &set) {
                Ok(message) => read += usize::from(message_columns(&message).is_ok()),
                Err(_) => refused += 1,
            }
        }
    }
    assert!(refused > 100 && read > 100, "{refused} refused, {read} read");
}

// Thirty messages that each have the next one twice would be a thousand million columns.
#[test]
fn a_type_of_too_many_columns_is_refused() {
    let messages = (0..14).map(|i| {
        let mut message = DescriptorProto { name: Some(format!("M{i}")), ..Default::default() };
        for name in ["a", "b"] {
            let field = field(&mut message, name, Type::Message, ProtoLabel::Optional);
            match i {
                13 => field.r#type = Some(Type::Int32.into()),
                _ => field.type_name = Some(format!(".M{}", i + 1)),
            }
        }
        message
    });
    let file = FileDescriptorProto {
        name: Some("m.proto".into()),
        syntax: Some("proto3".into()),
        message_type: messages.collect(),
        ..Default::default()
    };
    let schema = RawSchema {
        name: "M0".into(),
        encoding: "protobuf".into(),
        messages: "protobuf".into(),
        data: FileDescriptorSet { file: vec![file] }.encode_to_vec(),
    };
    let error = MessageLayout::from_schema(&schema).map(drop).expect_err("too many");
    assert!(error.contains("more than 4096 columns"), "{error}");
}

mod slow {
    use super::*;

    // An element of two bytes makes a row of the list's columns.
    #[test]
    fn a_small_message_does_not_fill_the_memory() {
        let descriptor = all();
        let tag = descriptor.get_field_by_name("r_m").expect("a field").number() << 3 | 2;
        let mut element = Vec::new();
        prost_reflect::prost::encoding::encode_varint(u64::from(tag), &mut element);
        element.push(0);
        let bytes = element.repeat(30_000_000);
        assert_eq!(decoder(&descriptor).push_message(&bytes), Err(Malformed::Expands));
    }

    #[test]
    fn damaged_messages_are_errors_or_rows() {
        let descriptor = all();
        let mut random = Random(5);
        for _ in 0..3000 {
            let mut bytes = random_message(&descriptor, &mut random, 0).encode_to_vec();
            bytes.truncate(1 + random.below(bytes.len() as u64) as usize);
            for _ in 0..random.below(4) {
                let at = random.below(bytes.len() as u64) as usize;
                bytes[at] = random.next() as u8;
            }
            let mut decoder = decoder(&descriptor);
            if decoder.push_message(&bytes).is_ok() {
                assert!(finish(&mut decoder).iter().all(|array| array.len() == 1));
            }
        }
    }
}
