//! Functions of the field: levels, responses, bands, geometry and symmetry, each a kernel of `dsp/` under a SQL name.

mod adapters;
mod aggregates;
mod comparison;
mod geometry;
mod levels;
mod lists;
#[cfg(test)]
mod manual;
mod responses;
mod standard;

use std::sync::Arc;

use datafusion::logical_expr::{AggregateUDF, ScalarUDF};
use echolake_schema::Rig;

use adapters::aggregate::wrap_aggregate;
use adapters::rig::RigFacts;
use adapters::scalar::wrap_scalar;
use aggregates::{average, p90_mean, panel_splits, value_counts};
use comparison::{alike, diffusion};
pub use echolake_dsp::full_scale_octave::measured_octave;
use geometry::{fresnel, sound, symmetry};
use responses::{band_energy, decay, nce, octave_band, rise, room_parameters, spectrum};
pub use standard::call_limits::{check_fixed_type, limited_functions};
pub use standard::call_stop::{StopFlag, check_stop, set_planning};
pub use standard::exact_aggregates::exact_aggregates;
pub use standard::limited_aggregates::{limited_aggregates, limited_windows};
pub use standard::list_members::{ANY_EQUAL, list_membership};
pub use standard::list_texts::{ending_condition, list_text};
pub use standard::number_ranges::whole_number_ranges;
pub use standard::octet_length::octet_length_of_bytes;
pub use standard::shared_percentiles::shared_percentiles;
pub use standard::text_concatenation::text_concatenation;
pub use standard::time_patterns::pattern_functions;
pub use standard::unified_floats::{FloatForm, UnifiedFloat, unified_floats};
pub use standard::zone_times::{AT_TIME_ZONE, zone_time};

/// All functions of a lake, made once for all its sessions.
///
/// ```
/// let functions = echolake_functions::FunctionSet::all(&echolake_schema::Rig::paper())?;
/// assert!(functions.names().any(|name| name == "band_energy"));
/// # Ok::<(), echolake_schema::Error>(())
/// ```
pub struct FunctionSet {
    scalar: Vec<Arc<ScalarUDF>>,
    aggregate: Vec<Arc<AggregateUDF>>,
}

impl FunctionSet {
    /// Creates the functions for a lake of this rig, from its sampling rate, bands and grid.
    ///
    /// # Errors
    /// [`echolake_schema::Error`] if the rig has no grid.
    pub fn all(rig: &Rig) -> Result<Self, echolake_schema::Error> {
        let facts = Arc::new(RigFacts::from_rig(rig)?);
        let mut scalar = vec![
            wrap_scalar(levels::DbFunction),
            wrap_scalar(levels::DbAmplitudeFunction),
            wrap_scalar(levels::SplFunction),
            wrap_scalar(levels::ListDbFunction),
            wrap_scalar(band_energy::BandEnergyFunction::new(&facts)),
            wrap_scalar(nce::NceFunction(facts.clone())),
            wrap_scalar(spectrum::SpectrumFunction),
            wrap_scalar(spectrum::SpectrumFrequenciesFunction(facts.clone())),
            wrap_scalar(decay::EdcFunction),
            wrap_scalar(decay::ArrivalFunction(facts.clone())),
            wrap_scalar(octave_band::BandFilterFunction(facts.clone())),
            wrap_scalar(room_parameters::RoomParametersFunction(facts.clone())),
            wrap_scalar(alike::PearsonFunction),
            wrap_scalar(alike::SpearmanFunction),
            wrap_scalar(alike::CorrelationPFunction),
            wrap_scalar(alike::SimilarityFunction),
            wrap_scalar(alike::RmsDifferenceFunction),
            wrap_scalar(diffusion::DiffusionFunction),
            wrap_scalar(diffusion::DiffusionNormalisedFunction),
            wrap_scalar(fresnel::FresnelFunction),
            wrap_scalar(sound::SpeedOfSoundFunction),
            wrap_scalar(symmetry::D4PositionFunction),
            wrap_scalar(symmetry::D4PointFunction(facts.clone())),
            wrap_scalar(symmetry::D4PairFunction(facts.clone())),
            wrap_scalar(symmetry::D4HeightmapFunction),
            wrap_scalar(lists::ListMultiplyFunction),
            wrap_scalar(lists::ListEnergyFunction),
            wrap_scalar(lists::ListRmsFunction),
        ];
        scalar.extend(rise::CurveShapeFunction::all(&facts).map(wrap_scalar));
        let aggregate = vec![
            wrap_aggregate(p90_mean::P90MeanFunction),
            wrap_aggregate(diffusion::DiffusionCoefficientFunction),
            wrap_aggregate(average::AvgListFunction),
            wrap_aggregate(panel_splits::PanelSplitsFunction),
            AggregateUDF::new_from_impl(value_counts::ValueCountFunction::mode()),
            AggregateUDF::new_from_impl(value_counts::ValueCountFunction::histogram()),
        ];
        Ok(Self {
            scalar: scalar.into_iter().map(Arc::new).collect(),
            aggregate: aggregate.into_iter().map(Arc::new).collect(),
        })
    }

    /// Returns the functions of the values of one row.
    pub fn scalar(&self) -> &[Arc<ScalarUDF>] {
        &self.scalar
    }

    /// Returns the names of all functions.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.scalar.iter().map(|f| f.name()).chain(self.aggregate.iter().map(|f| f.name()))
    }

    /// Returns the functions of the values of many rows.
    pub fn aggregate(&self) -> &[Arc<AggregateUDF>] {
        &self.aggregate
    }
}
