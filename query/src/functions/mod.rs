//! Functions of the field: levels, responses, bands, geometry and symmetry, each a kernel of `dsp/` under a SQL name.

mod aggregate;
mod alike;
mod answers;
mod arguments;
mod average;
mod band_energy;
mod decay;
mod description;
mod diffusion;
mod fresnel;
mod levels;
mod lists;
#[cfg(test)]
mod manual;
mod nce;
mod p90_mean;
mod per_length;
mod rig;
mod scalar;
mod sound;
mod spectrum;
mod symmetry;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use datafusion::logical_expr::{AggregateUDF, ScalarUDF};
use echolake_schema::Rig;

use aggregate::udaf;
use rig::Facts;
use scalar::udf;

/// All functions of a lake, made once for all its sessions.
pub struct Functions {
    scalar: Vec<Arc<ScalarUDF>>,
    aggregate: Vec<Arc<AggregateUDF>>,
}

impl Functions {
    /// Creates the functions for a lake of this rig, from its sampling rate, bands and grid.
    ///
    /// # Errors
    /// [`echolake_schema::Error`] if the rig has no grid.
    pub fn all(rig: &Rig) -> Result<Self, echolake_schema::Error> {
        let facts = Arc::new(Facts::of(rig)?);
        let scalar = vec![
            udf(levels::Db),
            udf(levels::DbAmplitude),
            udf(levels::Spl),
            udf(levels::ListDb),
            udf(band_energy::BandEnergy::new(&facts)),
            udf(nce::Nce(facts.clone())),
            udf(spectrum::Spectrum),
            udf(spectrum::Frequencies(facts.clone())),
            udf(decay::Edc),
            udf(decay::Arrival(facts.clone())),
            udf(alike::Pearson),
            udf(alike::Similarity),
            udf(diffusion::DiffusionOf),
            udf(fresnel::Fresnel),
            udf(sound::SpeedOfSound),
            udf(symmetry::D4),
            udf(symmetry::D4Point(facts.clone())),
            udf(symmetry::D4Pair(facts)),
            udf(symmetry::D4Heightmap),
            udf(lists::Multiply),
            udf(lists::Energy),
            udf(lists::Rms),
        ];
        let aggregate = vec![udaf(p90_mean::P90Mean), udaf(diffusion::DiffusionCoefficient), udaf(average::AvgList)];
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
