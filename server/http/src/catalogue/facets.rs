//! `GET /api/v1/surfaces`: a page of surfaces, with facets and histograms that leave their own filter out. All of it
//! comes from the summary in memory, in one pass a request.

use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;

use axum::Extension;
use echolake_service::RequestFault;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};
use utoipa::openapi::{ObjectBuilder, RefOr, Schema, Type};
use utoipa::{IntoParams, PartialSchema, ToSchema};

use super::super::extract::{NumberRange, QueryParams, RANGE_PATTERN, WholeNumber};
use super::content::{AnswerContent, EndpointAnswer};
use super::diffusion::{DiffusionCoefficients, read_diffusion};
use super::request::CatalogueRequest;
use super::snapshot::summary::{CatalogueSummary, SurfaceEntry, SurfaceSummary};

/// Values of a facet that are answered, the most frequent ones.
const MOST_VALUES: usize = 200;
const BINS: usize = 24;
/// A bin is never narrower, so that one value makes a bin and not a division by nothing.
const LEAST_WIDTH: f64 = 1e-9;
/// The facet value of surfaces for which it is not known.
const UNKNOWN: &str = "\u{2014}";

/// A text by which surfaces are distinguished: parameter, title, the surface's value, and the wanted ones.
struct SurfaceFacet {
    name: &'static str,
    label: &'static str,
    value: fn(&SurfaceSummary) -> Option<&str>,
    wanted: fn(&SurfacesQuery) -> &[String],
}

const FACETS: [SurfaceFacet; 6] = [
    SurfaceFacet { name: "typology", label: "Typology", value: |s| Some(&s.typology), wanted: |q| &q.typology },
    SurfaceFacet {
        name: "macrostructure",
        label: "Macrostructure",
        value: |s| s.macrostructure.as_deref(),
        wanted: |q| &q.macrostructure,
    },
    SurfaceFacet {
        name: "mesostructure",
        label: "Mesostructure",
        value: |s| s.mesostructure.as_deref(),
        wanted: |q| &q.mesostructure,
    },
    SurfaceFacet { name: "material", label: "Material", value: |s| Some(&s.material), wanted: |q| &q.material },
    SurfaceFacet {
        name: "flat_reference",
        label: "Flat reference",
        value: |s| Some(&s.flat_reference),
        wanted: |q| &q.flat_reference,
    },
    SurfaceFacet { name: "origin", label: "Origin", value: |s| Some(&s.origin), wanted: |q| &q.origin },
];

/// Filters, order and part of a page of surfaces.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct SurfacesQuery {
    /// Text in id, typology, structures, material, parameters.
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    q: Option<String>,
    typology: Vec<String>,
    macrostructure: Vec<String>,
    mesostructure: Vec<String>,
    material: Vec<String>,
    flat_reference: Vec<String>,
    origin: Vec<String>,
    /// `lo..hi` in days since 1970, as the histogram's bins.
    #[param(inline)]
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    started: Option<NumberRange>,
    /// `lo..hi` mm, root mean square. References have none.
    #[param(inline)]
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    relief: Option<NumberRange>,
    /// `band:lo..hi`, dB against Flat of the same band. References have none.
    #[param(inline)]
    level: Vec<LevelRange>,
    #[param(inline)]
    sort: SurfaceSort,
    /// A band's key, as in `lake.bands`.
    #[param(default = "total")]
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    sort_band: Option<String>,
    #[param(inline)]
    order: SurfaceDirection,
    #[param(inline)]
    offset: WholeNumber<0, { usize::MAX }, 0>,
    #[param(inline)]
    limit: WholeNumber<1, 500, 60>,
}

#[derive(Clone, Copy, Default, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(default = "surface_id")]
enum SurfaceSort {
    #[default]
    SurfaceId,
    Started,
    Relief,
    Spread,
    Level,
    /// As of /diffusion; references come last.
    Diffusion,
}

#[derive(Clone, Copy, Default, PartialEq, Eq, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
#[schema(default = "asc")]
enum SurfaceDirection {
    #[default]
    Asc,
    Desc,
}

/// Levels of a band, written `band:lo..hi`.
struct LevelRange {
    band: String,
    range: NumberRange,
}

impl<'de> Deserialize<'de> for LevelRange {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        let incomplete = || {
            D::Error::custom(format!("`{text}` is no range of a band; hint: a band and two numbers, as 2500:-6..0.5"))
        };
        let (band, range) = text.split_once(':').ok_or_else(incomplete)?;
        Ok(Self { band: band.to_owned(), range: NumberRange::parse(range).map_err(D::Error::custom)? })
    }
}

impl PartialSchema for LevelRange {
    fn schema() -> RefOr<Schema> {
        let pattern = format!("^[a-z0-9]+:{RANGE_PATTERN}$");
        ObjectBuilder::new().schema_type(Type::String).pattern(Some(pattern)).into()
    }
}

impl ToSchema for LevelRange {}

/// A page of surfaces.
#[derive(Serialize, ToSchema)]
struct SurfacePage<'a> {
    total: usize,
    offset: usize,
    items: Vec<&'a SurfaceSummary>,
    facets: Vec<FacetCounts<'a>>,
    histograms: Vec<SurfaceHistogram>,
    /// What the counts are: exact.
    counts: &'static str,
}

/// Surfaces by the values of a text.
#[derive(Serialize, ToSchema)]
#[schema(as = Facet)]
struct FacetCounts<'a> {
    /// The query parameter that filters by it.
    name: &'static str,
    label: &'static str,
    /// Designs differ in it, and not just as in a facet before it. References are not counted as designs.
    distinguishes: bool,
    values: Vec<FacetValue<'a>>,
}

/// A value, and the surfaces that have it.
#[derive(Serialize, ToSchema)]
struct FacetValue<'a> {
    value: &'a str,
    count: usize,
}

/// Surfaces by the values of a number.
#[derive(Serialize, ToSchema)]
#[schema(as = Histogram)]
struct SurfaceHistogram {
    /// The query parameter that filters by it, as `lo..hi`.
    name: String,
    label: String,
    unit: &'static str,
    bins: Vec<HistogramBin>,
}

/// Surfaces with values from one number to another.
#[derive(Serialize, ToSchema)]
#[schema(as = Bin)]
struct HistogramBin {
    from: f64,
    to: f64,
    count: usize,
}

/// A number by which surfaces are distinguished.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum SurfaceMeasure {
    /// Against Flat, of the band at this place.
    Level(usize),
    Relief,
    Started,
}

impl SurfaceMeasure {
    // References have neither level nor relief: they are what others are measured by.
    fn value_of(self, entry: &SurfaceEntry) -> Option<f64> {
        let is_design = !entry.surface.is_reference();
        let value = match self {
            Self::Level(band) => entry.surface.against_flat_db[band].filter(|_| is_design),
            Self::Relief => entry.surface.relief_rms_mm.filter(|_| is_design),
            Self::Started => entry.day,
        };
        value.filter(|v| v.is_finite())
    }
}

/// One filter; all must let a surface through.
enum SurfaceFilter<'a> {
    Words(Vec<String>),
    Facet(usize, Vec<&'a str>),
    Measure(SurfaceMeasure, Vec<RangeInclusive<f64>>),
}

impl SurfaceFilter<'_> {
    fn is_passed_by(&self, entry: &SurfaceEntry) -> bool {
        match self {
            Self::Words(words) => words.iter().all(|word| entry.words.contains(word)),
            Self::Facet(facet, wanted) => wanted.contains(&facet_value(*facet, &entry.surface)),
            Self::Measure(measure, ranges) => {
                measure.value_of(entry).is_some_and(|value| ranges.iter().any(|range| range.contains(&value)))
            }
        }
    }

    fn is_of_facet(&self, facet: usize) -> bool {
        matches!(self, Self::Facet(own, _) if *own == facet)
    }

    fn is_of(&self, measure: SurfaceMeasure) -> bool {
        matches!(self, Self::Measure(own, _) if *own == measure)
    }
}

fn facet_value(facet: usize, surface: &SurfaceSummary) -> &str {
    (FACETS[facet].value)(surface).unwrap_or(UNKNOWN)
}

fn surface_filters<'a>(
    query: &'a SurfacesQuery,
    summary: &CatalogueSummary,
) -> Result<Vec<SurfaceFilter<'a>>, RequestFault> {
    let mut filters = Vec::new();
    let words: Vec<_> = query.q.iter().flat_map(|q| q.split_whitespace()).map(str::to_lowercase).collect();
    if !words.is_empty() {
        filters.push(SurfaceFilter::Words(words));
    }
    for (i, facet) in FACETS.iter().enumerate() {
        let wanted: Vec<_> = (facet.wanted)(query).iter().map(String::as_str).collect();
        if !wanted.is_empty() {
            filters.push(SurfaceFilter::Facet(i, wanted));
        }
    }
    for (range, measure) in [(&query.started, SurfaceMeasure::Started), (&query.relief, SurfaceMeasure::Relief)] {
        if let Some(NumberRange(range)) = range {
            filters.push(SurfaceFilter::Measure(measure, vec![range.clone()]));
        }
    }
    let mut levels: BTreeMap<usize, Vec<_>> = BTreeMap::new();
    for level in &query.level {
        levels.entry(find_band(summary, "level", &level.band)?).or_default().push(level.range.0.clone());
    }
    filters
        .extend(levels.into_iter().map(|(band, ranges)| SurfaceFilter::Measure(SurfaceMeasure::Level(band), ranges)));
    Ok(filters)
}

fn find_band(summary: &CatalogueSummary, name: &str, key: &str) -> Result<usize, RequestFault> {
    summary.bands.iter().position(|band| band.key == key).ok_or_else(|| {
        let keys: Vec<_> = summary.bands.iter().map(|band| band.key.as_str()).collect();
        RequestFault::bad_request(format!("`{name}` names no band of the lake; hint: {}", keys.join(", ")))
    })
}

/// The filters that keep a surface out: none, exactly one, or more.
#[derive(Clone, Copy, PartialEq, Eq)]
enum FilterOutcome {
    In,
    /// This one alone.
    But(usize),
    Out,
}

fn filter_outcome(filters: &[SurfaceFilter<'_>], entry: &SurfaceEntry) -> FilterOutcome {
    let mut against = filters.iter().enumerate().filter(|(_, filter)| !filter.is_passed_by(entry));
    match (against.next(), against.next()) {
        (None, _) => FilterOutcome::In,
        (Some((only, _)), None) => FilterOutcome::But(only),
        _ => FilterOutcome::Out,
    }
}

/// A page of surfaces with facets.
///
/// Filters of different names are all required, values of one name are alternatives; a facet's counts leave its own
/// filter out. Computed from one summary per snapshot, held in memory.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces",
    tag = "catalogue",
    params(SurfacesQuery),
    responses((status = 200, description = "OK", body = SurfacePage)),
    extensions(("x-sql" = json!([
        "select s.*, r.started from surfaces s left join runs r using (run_id)",
        "select surface_id, band, p90_mean_db, p90_mean_u_db, spread_db from surface_stats",
    ])))
)]
pub(super) async fn surfaces(
    Extension(request): Extension<CatalogueRequest>,
    QueryParams(query): QueryParams<SurfacesQuery>,
) -> EndpointAnswer {
    let summary = request.read_summary().await?;
    let filters = surface_filters(&query, summary)?;
    let diffusion = match query.sort {
        SurfaceSort::Diffusion => Some(read_diffusion(&request).await?),
        _ => None,
    };
    let order = surface_order(&query, summary, diffusion)?;
    let all: Vec<_> = summary.entries.iter().map(|entry| (entry, filter_outcome(&filters, entry))).collect();
    let mut left: Vec<_> =
        all.iter().filter(|(_, standing)| *standing == FilterOutcome::In).map(|(entry, _)| *entry).collect();
    left.sort_by(|a, b| order.compare_entries(a, b));
    Ok(AnswerContent::encode_json(&SurfacePage {
        total: left.len(),
        offset: query.offset.get(),
        items: left.into_iter().skip(query.offset.get()).take(query.limit.get()).map(|entry| &entry.surface).collect(),
        facets: (0..FACETS.len()).map(|facet| count_facet(facet, &filters, &all)).collect(),
        histograms: surface_histograms(summary, &filters, &all),
        counts: "exact",
    })?)
}

fn count_facet<'a>(
    facet: usize,
    filters: &[SurfaceFilter<'_>],
    all: &[(&'a SurfaceEntry, FilterOutcome)],
) -> FacetCounts<'a> {
    let own = filters.iter().position(|f| f.is_of_facet(facet));
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    for (entry, standing) in all {
        *counts.entry(facet_value(facet, &entry.surface)).or_default() += usize::from(is_counted(*standing, own));
    }
    let mut values: Vec<_> = counts.into_iter().map(|(value, count)| FacetValue { value, count }).collect();
    values.sort_by(|a, b| b.count.cmp(&a.count).then_with(|| a.value.cmp(b.value)));
    values.truncate(MOST_VALUES);
    let distinguishes = is_distinguishing(facet, all);
    FacetCounts { name: FACETS[facet].name, label: FACETS[facet].label, distinguishes, values }
}

fn is_distinguishing(facet: usize, all: &[(&SurfaceEntry, FilterOutcome)]) -> bool {
    let designs = || all.iter().map(|(entry, _)| &entry.surface).filter(|surface| !surface.is_reference());
    let values: BTreeSet<_> = designs().map(|surface| facet_value(facet, surface)).collect();
    let is_same = |earlier: usize| {
        let both: BTreeSet<_> =
            designs().map(|surface| (facet_value(facet, surface), facet_value(earlier, surface))).collect();
        let others: BTreeSet<_> = both.iter().map(|(_, earlier)| *earlier).collect();
        both.len() == values.len() && both.len() == others.len()
    };
    values.len() > 1 && !(0..facet).any(is_same)
}

// Whether a surface is let through by all filters but one's own.
fn is_counted(standing: FilterOutcome, own: Option<usize>) -> bool {
    match standing {
        FilterOutcome::In => true,
        FilterOutcome::But(only) => Some(only) == own,
        FilterOutcome::Out => false,
    }
}

fn surface_histograms(
    summary: &CatalogueSummary,
    filters: &[SurfaceFilter<'_>],
    all: &[(&SurfaceEntry, FilterOutcome)],
) -> Vec<SurfaceHistogram> {
    let levels = summary.bands.iter().enumerate().map(|(i, band)| {
        (SurfaceMeasure::Level(i), format!("level:{}", band.key), format!("{} against Flat", band.label), "dB")
    });
    let others = [
        (SurfaceMeasure::Relief, "relief".to_owned(), "Relief, rms".to_owned(), "mm"),
        (SurfaceMeasure::Started, "started".to_owned(), "Measured".to_owned(), "day"),
    ];
    let all = levels.chain(others).filter_map(|(measure, name, label, unit)| {
        let own = filters.iter().position(|f| f.is_of(measure));
        let values =
            all.iter().filter_map(|(entry, standing)| Some((measure.value_of(entry)?, is_counted(*standing, own))));
        Some(SurfaceHistogram { name, label, unit, bins: histogram_bins(&values.collect::<Vec<_>>())? })
    });
    all.collect()
}

// Bins over all values, which do not move when something is filtered; counts of those that are left.
fn histogram_bins(values: &[(f64, bool)]) -> Option<Vec<HistogramBin>> {
    let low = values.iter().map(|v| v.0).min_by(f64::total_cmp)?;
    let high = values.iter().map(|v| v.0).max_by(f64::total_cmp)?;
    let width = ((high - low) / BINS as f64).max(LEAST_WIDTH);
    let mut counts = [0; BINS];
    for (value, _) in values.iter().filter(|(_, counted)| *counted) {
        counts[(((value - low) / width) as usize).min(BINS - 1)] += 1;
    }
    let edge = |i: usize| low + i as f64 * width;
    Some(
        counts
            .into_iter()
            .enumerate()
            .map(|(i, count)| HistogramBin { from: edge(i), to: edge(i + 1), count })
            .collect(),
    )
}

/// In which order surfaces come.
struct SurfaceOrder<'a> {
    by: Option<SortKey<'a>>,
    descends: bool,
}

/// The sort key of surfaces, if it is not their name.
enum SortKey<'a> {
    Measure(SurfaceMeasure),
    Spread(usize),
    Diffusion(&'a DiffusionCoefficients, usize),
}

fn surface_order<'a>(
    query: &SurfacesQuery,
    summary: &CatalogueSummary,
    diffusion: Option<&'a DiffusionCoefficients>,
) -> Result<SurfaceOrder<'a>, RequestFault> {
    let band = match &query.sort_band {
        Some(key) => find_band(summary, "sort_band", key)?,
        None => summary.bands.len() - 1,
    };
    let by = match query.sort {
        SurfaceSort::SurfaceId => None,
        SurfaceSort::Started => Some(SortKey::Measure(SurfaceMeasure::Started)),
        SurfaceSort::Relief => Some(SortKey::Measure(SurfaceMeasure::Relief)),
        SurfaceSort::Spread => Some(SortKey::Spread(band)),
        SurfaceSort::Level => Some(SortKey::Measure(SurfaceMeasure::Level(band))),
        SurfaceSort::Diffusion => diffusion.map(|found| SortKey::Diffusion(found, band)),
    };
    Ok(SurfaceOrder { by, descends: query.order == SurfaceDirection::Desc })
}

impl SurfaceOrder<'_> {
    fn compare_entries(&self, a: &SurfaceEntry, b: &SurfaceEntry) -> Ordering {
        let turned = |ordering: Ordering| if self.descends { ordering.reverse() } else { ordering };
        let value = |entry: &SurfaceEntry| match self.by.as_ref()? {
            SortKey::Measure(measure) => measure.value_of(entry),
            SortKey::Spread(band) => entry.surface.spread_db[*band],
            SortKey::Diffusion(_, _) if entry.surface.is_reference() => None,
            SortKey::Diffusion(found, band) => found.get(&entry.surface.surface_id)?.get(*band).copied().flatten(),
        };
        let names = || natural_order(&a.surface.surface_id, &b.surface.surface_id);
        match (self.by.is_some(), value(a), value(b)) {
            (false, ..) => turned(names()),
            (true, Some(x), Some(y)) => turned(x.total_cmp(&y)).then_with(names),
            // Unknown values come last, in either direction.
            (true, x, y) => y.is_some().cmp(&x.is_some()).then_with(names),
        }
    }
}

// Digits by the number that they make: `panel_9` before `panel_10`.
fn natural_order(a: &str, b: &str) -> Ordering {
    let mut a = a;
    let mut b = b;
    loop {
        let digits_a = leading_digits(a);
        let digits_b = leading_digits(b);
        let ordering = match (digits_a.is_empty() || digits_b.is_empty(), a.chars().next(), b.chars().next()) {
            (false, ..) => {
                let number = |text: &str| text.trim_start_matches('0').to_owned();
                let x = number(digits_a);
                let y = number(digits_b);
                x.len().cmp(&y.len()).then_with(|| x.cmp(&y)).then_with(|| digits_a.len().cmp(&digits_b.len()))
            }
            (true, None, None) => return Ordering::Equal,
            (true, x, y) => x.cmp(&y),
        };
        if ordering != Ordering::Equal {
            return ordering;
        }
        let step = |text: &str, digits: &str| if digits.is_empty() { first_len(text) } else { digits.len() };
        let step_a = step(a, digits_a);
        let step_b = step(b, digits_b);
        (a, b) = (&a[step_a..], &b[step_b..]);
    }
}

fn leading_digits(text: &str) -> &str {
    &text[..text.bytes().take_while(u8::is_ascii_digit).count()]
}

fn first_len(text: &str) -> usize {
    text.chars().next().map_or(0, char::len_utf8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_sort_as_people_count() {
        let mut names = ["p10", "p9", "flat", "p9b", "0015_0", "15_0", "p", "é2", "é10"];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(names, ["15_0", "0015_0", "flat", "p", "p9", "p9b", "p10", "é2", "é10"]);
    }

    #[test]
    fn bins_hold_what_is_counted() {
        let values: Vec<_> = (0..48).map(|i| (f64::from(i), i % 2 == 0)).collect();
        let bins = histogram_bins(&values).expect("bins");
        assert_eq!(bins.len(), BINS);
        assert_eq!(bins.iter().map(|b| b.count).sum::<usize>(), 24);
        assert!((bins[BINS - 1].to - 47.0).abs() < 1e-9);
        assert!(super::histogram_bins(&[]).is_none());
        assert_eq!(super::histogram_bins(&[(3.0, true)]).expect("one value")[0].count, 1);
    }

    #[test]
    fn a_facet_leaves_its_own_filter_out() {
        assert!(is_counted(FilterOutcome::In, None) && is_counted(FilterOutcome::But(2), Some(2)));
        assert!(!is_counted(FilterOutcome::But(2), Some(1)) && !is_counted(FilterOutcome::But(0), None));
        assert!(!is_counted(FilterOutcome::Out, Some(0)));
    }
}
