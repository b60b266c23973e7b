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

use adapters::aggregate::udaf;
use adapters::rig::RigFacts;
use adapters::scalar::udf;
use aggregates::{average, p90_mean, value_counts};
use comparison::{alike, diffusion};
use geometry::{fresnel, sound, symmetry};
use responses::{band_energy, decay, nce, rise, spectrum};
pub use standard::octet_length::octet_length_of_bytes;
pub use standard::time_patterns::pattern_functions;

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
        let facts = Arc::new(RigFacts::of(rig)?);
        let mut scalar = vec![
            udf(levels::DbFunction),
            udf(levels::DbAmplitudeFunction),
            udf(levels::SplFunction),
            udf(levels::ListDbFunction),
            udf(band_energy::BandEnergyFunction::new(&facts)),
            udf(nce::NceFunction(facts.clone())),
            udf(spectrum::SpectrumFunction),
            udf(spectrum::SpectrumFrequenciesFunction(facts.clone())),
            udf(decay::EdcFunction),
            udf(decay::ArrivalFunction(facts.clone())),
            udf(alike::PearsonFunction),
            udf(alike::SimilarityFunction),
            udf(diffusion::DiffusionFunction),
            udf(fresnel::FresnelFunction),
            udf(sound::SpeedOfSoundFunction),
            udf(symmetry::D4PositionFunction),
            udf(symmetry::D4PointFunction(facts.clone())),
            udf(symmetry::D4PairFunction(facts.clone())),
            udf(symmetry::D4HeightmapFunction),
            udf(lists::ListMultiplyFunction),
            udf(lists::ListEnergyFunction),
            udf(lists::ListRmsFunction),
        ];
        scalar.extend(rise::CurveShapeFunction::all(&facts).map(udf));
        let aggregate = vec![
            udaf(p90_mean::P90MeanFunction),
            udaf(diffusion::DiffusionCoefficientFunction),
            udaf(average::AvgListFunction),
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
