//! Typed parts of paths and typed parameters. Each defect is answered as a [`ProblemResponse`] that says what is
//! allowed.

use std::ops::RangeInclusive;

use axum::extract::{FromRequestParts, Path};
use axum::http::Uri;
use axum::http::request::Parts;
use echolake_service::RequestFault;
use serde::Deserialize;
use serde::de::{DeserializeOwned, Deserializer, Error as _};
use serde_html_form::Deserializer as FormDeserializer;
use serde_path_to_error::Segment;
use utoipa::openapi::{KnownFormat, ObjectBuilder, RefOr, Schema, SchemaFormat, Type};
use utoipa::{PartialSchema, ToSchema};

use super::problem::ProblemResponse;

/// What serde_html_form says of several values if its field is no list.
const LIST_FOUND: &str = "unsupported value";

/// The named parts of a path.
pub(super) struct PathParams<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned + Send> FromRequestParts<S> for PathParams<T> {
    type Rejection = ProblemResponse;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, ProblemResponse> {
        let path = Path::from_request_parts(parts, state).await;
        let Path(path) = path.map_err(|_| RequestFault::bad_request("the path is not UTF-8"))?;
        Ok(Self(path))
    }
}

/// The parameters after the path's `?`. A field that is a list has all values of its name; another name may be there
/// once.
pub(super) struct QueryParams<T>(pub T);

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
    let params = FormDeserializer::from_bytes(uri.query().unwrap_or_default().as_bytes());
    serde_path_to_error::deserialize(params).map_err(|error| {
        let mut defect = error.inner().to_string();
        if defect == LIST_FOUND {
            defect = "it is there twice".to_owned();
        }
        RequestFault::bad_request(match error.path().iter().next() {
            Some(Segment::Map { key: name }) => format!("`{name}`: {defect}"),
            _ => format!("the parameters are not right: {defect}"),
        })
    })
}

/// Reads an optional parameter that is there. Without a value it is an empty text, as other texts, and not left out:
/// serde_html_form takes `where=` for no predicate, which is another question.
///
/// # Errors
/// What the parameter's type says.
pub(super) fn read_present<'de, D: Deserializer<'de>, T: Deserialize<'de>>(
    deserializer: D,
) -> Result<Option<T>, D::Error> {
    T::deserialize(deserializer).map(Some)
}

/// A parameter that is a whole number within bounds, and that has a default.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct WholeNumber<const LOW: usize, const HIGH: usize, const DEFAULT: usize>(usize);

impl<const LOW: usize, const HIGH: usize, const DEFAULT: usize> WholeNumber<LOW, HIGH, DEFAULT> {
    /// Returns the number.
    pub fn get(self) -> usize {
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
/// The text, and what is allowed.
pub(super) fn parse_whole(text: &str, bounds: RangeInclusive<usize>) -> Result<usize, String> {
    let digits = text.bytes().all(|b| b.is_ascii_digit());
    let value = text.parse().ok().filter(|n| digits && bounds.contains(n));
    value.ok_or_else(|| format!("`{text}` is no whole number from {} to {}", bounds.start(), bounds.end()))
}

/// A range of numbers, written `lo..hi`.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct NumberRange(pub RangeInclusive<f64>);

impl NumberRange {
    /// Reads `lo..hi`.
    ///
    /// # Errors
    /// The text, and what is allowed.
    pub fn parse(text: &str) -> Result<Self, String> {
        let number = |text: &str| text.parse::<f64>().ok().filter(|n| n.is_finite());
        let bounds = text.split_once("..").and_then(|(low, high)| Some(number(low)?..=number(high)?));
        let bounds = bounds.filter(|b| b.start() <= b.end());
        bounds.map(Self).ok_or_else(|| format!("`{text}` is no range; hint: two numbers, the lower first, as -6..0.5"))
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
pub enum BinaryContent {}

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
    #[serde(default, deny_unknown_fields)]
    struct TestQuery {
        #[serde(deserialize_with = "read_present")]
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
        assert_eq!(query("a=1&b=x%20y&b=%3C&limit=007&order=desc&level=-6..0.5"), Ok(expected));
        assert!(query("a=%ff").is_ok());
        assert_eq!(query("a=").map(|query| query.a), Ok(Some(String::new())));
    }

    #[test]
    fn defects_say_what_is_allowed() {
        for wrong in ["0", "501", "+7", "7.0", "", "x", "99999999999999999999"] {
            let expected = format!("`limit`: `{wrong}` is no whole number from 1 to 500");
            assert_eq!(query(&format!("limit={}", wrong.replace('+', "%2B"))), Err(expected));
        }
        for wrong in ["", "1", "1..", "..1", "a..b", "1..inf", "NaN..1", "1...2", "2..1"] {
            let expected = format!("`level`: `{wrong}` is no range; hint: two numbers, the lower first, as -6..0.5");
            assert_eq!(query(&format!("level=1..2&level={wrong}")), Err(expected));
        }
        assert_eq!(query("order=up"), Err("`order`: unknown variant `up`, expected `asc` or `desc`".into()));
        let unknown = "`other`: unknown field `other`, expected one of `a`, `b`, `limit`, `order`, `level`";
        assert_eq!(query("a=1&other=2"), Err(unknown.into()));
        for twice in ["a=1&a=1", "limit=1&b=2&limit=1", "order=asc&order=asc"] {
            let name = twice.split('=').next().expect("a name");
            assert_eq!(query(twice), Err(format!("`{name}`: it is there twice")));
        }
    }
}
