//! Typed parts of paths and typed parameters. Each defect is answered as a [`ProblemResponse`] that says what is allowed.

use std::fmt;
use std::ops::RangeInclusive;
use std::vec;

use axum::extract::{FromRequestParts, Path, Query};
use axum::http::Uri;
use axum::http::request::Parts;
use serde::de::value::{MapAccessDeserializer, SeqDeserializer, StrDeserializer};
use serde::de::{
    DeserializeOwned, DeserializeSeed, Deserializer, Error as _, IntoDeserializer as _, MapAccess, Visitor,
};
use serde::{Deserialize, forward_to_deserialize_any};
use utoipa::openapi::{KnownFormat, ObjectBuilder, RefOr, Schema, SchemaFormat, Type};
use utoipa::{PartialSchema, ToSchema};

use super::problem::ProblemResponse;
use crate::fault::RequestFault;

/// The named parts of a path.
pub(super) struct PathParams<T>(pub(super) T);

impl<S: Send + Sync, T: DeserializeOwned + Send> FromRequestParts<S> for PathParams<T> {
    type Rejection = ProblemResponse;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, ProblemResponse> {
        let path = Path::from_request_parts(parts, state).await;
        let Path(path) = path.map_err(|_| RequestFault::request("the path is not UTF-8"))?;
        Ok(Self(path))
    }
}

/// The parameters after the path's `?`. A field that is a list has all values of its name; another name may be there
/// once.
pub(super) struct QueryParams<T>(pub(super) T);

impl<S: Send + Sync, T: DeserializeOwned> FromRequestParts<S> for QueryParams<T> {
    type Rejection = ProblemResponse;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, ProblemResponse> {
        Ok(Self(parse_query(&parts.uri)?))
    }
}

/// Reads the parameters of an address.
///
/// # Errors
/// [`RequestFault::Request`] if a name or a value is not allowed.
pub(super) fn parse_query<T: DeserializeOwned>(uri: &Uri) -> Result<T, RequestFault> {
    let Query(pairs) = Query::<Vec<(String, String)>>::try_from_uri(uri)
        .map_err(|_| RequestFault::request("the parameters are not UTF-8"))?;
    let mut names: Vec<(&str, Vec<&str>)> = Vec::new();
    for (name, value) in &pairs {
        match names.iter_mut().find(|(known, _)| known == name) {
            Some((_, values)) => values.push(value),
            None => names.push((name, vec![value])),
        }
    }
    let access = ParamAccess { rest: names.into_iter(), values: None };
    T::deserialize(MapAccessDeserializer::new(access)).map_err(|e| RequestFault::request(e.0))
}

/// The defect of a parameter, without its name or with it.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct ParamError(String);

impl serde::de::Error for ParamError {
    fn custom<M: fmt::Display>(message: M) -> Self {
        Self(message.to_string())
    }

    fn unknown_variant(found: &str, known: &'static [&'static str]) -> Self {
        Self(format!("is `{found}`; hint: {}", known.join(", ")))
    }

    fn unknown_field(found: &str, known: &'static [&'static str]) -> Self {
        Self(format!("there is no parameter `{found}`; hint: {}", known.join(", ")))
    }
}

/// Parameters by name.
struct ParamAccess<'a> {
    rest: vec::IntoIter<(&'a str, Vec<&'a str>)>,
    values: Option<(&'a str, Vec<&'a str>)>,
}

impl<'de> MapAccess<'de> for ParamAccess<'de> {
    type Error = ParamError;

    fn next_key_seed<K: DeserializeSeed<'de>>(&mut self, seed: K) -> Result<Option<K::Value>, ParamError> {
        self.values = self.rest.next();
        let name = self.values.as_ref().map(|(name, _)| StrDeserializer::new(name));
        name.map(|name| seed.deserialize(name)).transpose()
    }

    fn next_value_seed<V: DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value, ParamError> {
        let (name, values) = self.values.take().unwrap_or_default();
        seed.deserialize(ParamValues(values)).map_err(|e| ParamError(format!("`{name}` {e}")))
    }
}

/// The values of one name.
struct ParamValues<'a>(Vec<&'a str>);

impl<'de> ParamValues<'de> {
    fn one(&self) -> Result<StrDeserializer<'de, ParamError>, ParamError> {
        match self.0[..] {
            [value] => Ok(value.into_deserializer()),
            _ => Err(ParamError::custom("is there twice")),
        }
    }
}

impl<'de> Deserializer<'de> for ParamValues<'de> {
    type Error = ParamError;

    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, ParamError> {
        self.one()?.deserialize_any(visitor)
    }

    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, ParamError> {
        visitor.visit_some(self)
    }

    fn deserialize_seq<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, ParamError> {
        visitor.visit_seq(SeqDeserializer::new(self.0.into_iter()))
    }

    fn deserialize_enum<V: Visitor<'de>>(
        self,
        name: &'static str,
        variants: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, ParamError> {
        self.one()?.deserialize_enum(name, variants, visitor)
    }

    fn deserialize_ignored_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, ParamError> {
        visitor.visit_unit()
    }

    forward_to_deserialize_any! {
        bool i8 i16 i32 i64 i128 u8 u16 u32 u64 u128 f32 f64 char str string bytes byte_buf unit unit_struct
        newtype_struct tuple tuple_struct map struct identifier
    }
}

/// A parameter that is a whole number within bounds, and that has a default.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct WholeNumber<const LOW: usize, const HIGH: usize, const DEFAULT: usize>(usize);

impl<const LOW: usize, const HIGH: usize, const DEFAULT: usize> WholeNumber<LOW, HIGH, DEFAULT> {
    /// Returns the number.
    pub(super) fn get(self) -> usize {
        self.0
    }
}

impl<const LOW: usize, const HIGH: usize, const DEFAULT: usize> Default for WholeNumber<LOW, HIGH, DEFAULT> {
    fn default() -> Self {
        Self(DEFAULT)
    }
}

impl<'de, const LOW: usize, const HIGH: usize, const DEFAULT: usize> Deserialize<'de>
    for WholeNumber<LOW, HIGH, DEFAULT>
{
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        parse_whole(&text, LOW..=HIGH).map(Self).map_err(D::Error::custom)
    }
}

impl<const LOW: usize, const HIGH: usize, const DEFAULT: usize> PartialSchema for WholeNumber<LOW, HIGH, DEFAULT> {
    fn schema() -> RefOr<Schema> {
        let maximum = Some(HIGH).filter(|high| *high < usize::MAX);
        let number = ObjectBuilder::new().schema_type(Type::Integer).minimum(Some(LOW)).maximum(maximum);
        number.default(Some(DEFAULT.into())).into()
    }
}

impl<const LOW: usize, const HIGH: usize, const DEFAULT: usize> ToSchema for WholeNumber<LOW, HIGH, DEFAULT> {}

/// Reads a whole number. It has no sign and no spaces, so that one number makes one address.
///
/// # Errors
/// What the text is and what is allowed, to be put after the parameter's name.
pub(super) fn parse_whole(text: &str, bounds: RangeInclusive<usize>) -> Result<usize, String> {
    let digits = text.bytes().all(|b| b.is_ascii_digit());
    let value = text.parse().ok().filter(|n| digits && bounds.contains(n));
    value.ok_or_else(|| format!("is `{text}`; hint: a whole number from {} to {}", bounds.start(), bounds.end()))
}

/// A range of numbers, written `lo..hi`.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct NumberRange(pub(super) RangeInclusive<f64>);

impl NumberRange {
    /// Reads `lo..hi`.
    ///
    /// # Errors
    /// What the text is and what is allowed, to be put after the parameter's name.
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        let number = |text: &str| text.parse::<f64>().ok().filter(|n| n.is_finite());
        let bounds = text.split_once("..").and_then(|(low, high)| Some(number(low)?..=number(high)?));
        let bounds = bounds.filter(|b| b.start() <= b.end());
        bounds.map(Self).ok_or_else(|| format!("is `{text}`; hint: two numbers, the lower first, as -6..0.5"))
    }
}

impl<'de> Deserialize<'de> for NumberRange {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Self::parse(&String::deserialize(deserializer)?).map_err(D::Error::custom)
    }
}

/// What may be read as a [`NumberRange`], as a regular expression.
pub(super) const RANGE_PATTERN: &str = r"-?[0-9]+(\.[0-9]+)?\.\.-?[0-9]+(\.[0-9]+)?";

impl PartialSchema for NumberRange {
    fn schema() -> RefOr<Schema> {
        ObjectBuilder::new().schema_type(Type::String).pattern(Some(format!("^{RANGE_PATTERN}$"))).into()
    }
}

impl ToSchema for NumberRange {}

/// Bytes, for the contract.
pub(super) enum BinaryContent {}

impl PartialSchema for BinaryContent {
    fn schema() -> RefOr<Schema> {
        let format = SchemaFormat::KnownFormat(KnownFormat::Binary);
        ObjectBuilder::new().schema_type(Type::String).format(Some(format)).into()
    }
}

impl ToSchema for BinaryContent {}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Default, PartialEq, Deserialize)]
    #[serde(rename_all = "lowercase")]
    enum RowOrder {
        #[default]
        Asc,
        Desc,
    }

    #[derive(Debug, Default, PartialEq, Deserialize)]
    #[serde(default)]
    struct TestQuery {
        a: Option<String>,
        b: Vec<String>,
        limit: WholeNumber<1, 500, 60>,
        order: RowOrder,
        level: Vec<NumberRange>,
    }

    fn query(text: &str) -> Result<TestQuery, String> {
        parse_query(&format!("/x?{text}").parse().expect("a path")).map_err(|e| e.to_string())
    }

    #[test]
    fn parameters_are_fields() {
        assert_eq!(query(""), Ok(TestQuery { limit: WholeNumber(60), ..TestQuery::default() }));
        let expected = TestQuery {
            a: Some("1".into()),
            b: vec!["x y".into(), "<".into()],
            limit: WholeNumber(7),
            order: RowOrder::Desc,
            level: vec![NumberRange(-6.0..=0.5)],
        };
        assert_eq!(query("a=1&b=x%20y&b=%3C&limit=007&order=desc&level=-6..0.5&other=1&other=2"), Ok(expected));
        assert!(query("a=%ff").is_ok());
    }

    #[test]
    fn defects_say_what_is_allowed() {
        for wrong in ["0", "501", "+7", "7.0", "", "x", "99999999999999999999"] {
            let expected = format!("`limit` is `{wrong}`; hint: a whole number from 1 to 500");
            assert_eq!(query(&format!("limit={}", wrong.replace('+', "%2B"))), Err(expected));
        }
        for wrong in ["", "1", "1..", "..1", "a..b", "1..inf", "NaN..1", "1...2", "2..1"] {
            let expected = format!("`level` is `{wrong}`; hint: two numbers, the lower first, as -6..0.5");
            assert_eq!(query(&format!("level=1..2&level={wrong}")), Err(expected));
        }
        assert_eq!(query("order=up"), Err("`order` is `up`; hint: asc, desc".into()));
        for twice in ["a=1&a=1", "limit=1&b=2&limit=1", "order=asc&order=asc"] {
            let name = twice.split('=').next().expect("a name");
            assert_eq!(query(twice), Err(format!("`{name}` is there twice")));
        }
    }
}
