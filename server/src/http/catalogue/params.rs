//! A request's parameters: a value that violates the contract is refused with a hint of what is allowed.

use std::ops::RangeInclusive;

use axum::extract::Query;
use axum::http::Uri;

use crate::fault::RequestFault;

/// The query part of a URL, after the `?`.
#[derive(Default)]
pub(in super::super) struct RequestParams(Vec<(String, String)>);

impl RequestParams {
    /// # Errors
    /// [`RequestFault::Request`] if it is not form-encoded.
    pub(in super::super) fn of(uri: &Uri) -> Result<Self, RequestFault> {
        let Query(pairs) =
            Query::try_from_uri(uri).map_err(|_| RequestFault::request("the parameters are not UTF-8"))?;
        Ok(Self(pairs))
    }

    /// The names, as often as they are there.
    pub(in super::super) fn names(&self) -> impl Iterator<Item = &str> {
        self.0.iter().map(|(name, _)| name.as_str())
    }

    /// All values of a name.
    pub(in super::super) fn all<'a>(&'a self, name: &str) -> impl Iterator<Item = &'a str> {
        self.0.iter().filter(move |(n, _)| n == name).map(|(_, value)| value.as_str())
    }

    /// The value of a name that may be there once.
    pub(in super::super) fn one(&self, name: &str) -> Result<Option<&str>, RequestFault> {
        let mut values = self.all(name);
        match (values.next(), values.next()) {
            (value, None) => Ok(value),
            _ => Err(RequestFault::request(format!("`{name}` is there twice"))),
        }
    }

    /// A whole number within bounds.
    pub(super) fn whole(&self, name: &str, bounds: RangeInclusive<usize>) -> Result<Option<usize>, RequestFault> {
        let Some(text) = self.one(name)? else { return Ok(None) };
        // No sign, no spaces: the same number is one address.
        let digits = text.bytes().all(|b| b.is_ascii_digit());
        let value = text.parse().ok().filter(|n| digits && bounds.contains(n));
        value.map(Some).ok_or_else(|| {
            let (low, high) = (bounds.start(), bounds.end());
            RequestFault::request(format!("`{name}` is `{text}`; hint: a whole number from {low} to {high}"))
        })
    }

    /// Returns one of a few words, the first if none is given.
    pub(in super::super) fn choice(
        &self,
        name: &str,
        words: &'static [&'static str],
    ) -> Result<&'static str, RequestFault> {
        let Some(text) = self.one(name)? else { return Ok(words[0]) };
        let known = words.iter().copied().find(|word| *word == text);
        known.ok_or_else(|| RequestFault::request(format!("`{name}` is `{text}`; hint: {}", words.join(", "))))
    }
}

/// Reads `lo..hi`.
///
/// # Errors
/// [`RequestFault::Request`] if it is not that.
pub(super) fn range(name: &str, text: &str) -> Result<RangeInclusive<f64>, RequestFault> {
    let number = |text: &str| text.parse::<f64>().ok().filter(|n| n.is_finite());
    let bounds = text.split_once("..").and_then(|(low, high)| Some(number(low)?..=number(high)?));
    let bounds = bounds.filter(|b| b.start() <= b.end());
    bounds.ok_or_else(|| {
        RequestFault::request(format!("`{name}` is `{text}`; hint: two numbers, the lower first, as -6..0.5"))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn params(query: &str) -> RequestParams {
        RequestParams::of(&format!("/x?{query}").parse().expect("a path")).expect("parameters")
    }

    #[test]
    fn parameters_are_taken_by_name() {
        let given = params("a=1&b=x%20y&b=%3C&limit=007");
        assert_eq!(given.all("b").collect::<Vec<_>>(), ["x y", "<"]);
        assert_eq!(given.one("a").expect("one"), Some("1"));
        assert!(given.one("b").is_err());
        assert_eq!(given.whole("limit", 1..=500).expect("a number"), Some(7));
        for wrong in
            ["limit=0", "limit=501", "limit=+7", "limit=7.0", "limit=", "limit=x", "limit=99999999999999999999"]
        {
            assert!(params(wrong).whole("limit", 1..=500).is_err(), "{wrong}");
        }
        assert_eq!(given.choice("order", &["asc", "desc"]).expect("the first"), "asc");
        assert!(params("order=up").choice("order", &["asc", "desc"]).is_err());
        assert!(RequestParams::of(&"/x?a=%ff".parse().expect("a path")).is_ok_and(|p| p.all("a").count() == 1));
    }

    #[test]
    fn ranges_are_two_numbers() {
        assert_eq!(range("level", "-6..0.5").expect("a range"), -6.0..=0.5);
        for wrong in ["", "1", "1..", "..1", "a..b", "1..inf", "NaN..1", "1...2"] {
            assert!(range("level", wrong).is_err(), "{wrong}");
        }
    }
}
