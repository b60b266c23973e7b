//! The references that a surface names: their runs, their versions, and their mean responses.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use echolake_dsp::foam::subtract_foam;
use echolake_dsp::foam_reflection::FoamReflectionFit;
use echolake_dsp::geometry::{direct_mm, image_mm};
use echolake_dsp::temperature::speed_of_sound;
use echolake_dsp::uncertainty::{DirectSoundResidual, EnergySensitivity, TemperatureResponse};
use echolake_lake::{DataFile, DirectSound, FileName, Lake, LakeSnapshot, ReferenceSurfaces};
use echolake_schema::tables::Table;
use echolake_schema::{PairId, SurfaceId, SurfaceRecord};
use futures::future::try_join_all;
use sha2::{Digest as _, Sha256};
use tokio::sync::Mutex;

use crate::CODE_VERSION;
use crate::derived_values::{
    FlatPair, FlatPairs, MeanResponse, MeanResponses, derivation_plan, residual_fit, temperature_response,
};
use crate::error::{Error, Result};
use crate::pipeline::Cores;
use crate::read_back;

/// Revision of the rows that follow from references: those of another one are derived anew.
const ROWS_REVISION: &str = "5";
/// Number of hex digits of a digest in a version.
const VERSION_DIGITS: usize = 12;

/// Finds references in one snapshot, and caches their responses.
pub(crate) struct ReferenceFinder {
    lake: Lake,
    snapshot: Arc<LakeSnapshot>,
    /// The references that each surface's row names.
    names: HashMap<SurfaceId, ReferenceNames>,
    versions: HashMap<SurfaceId, String>,
    /// Keyed by version: the means change with the runs, and so does the version.
    means: HashMap<String, Arc<MeanResponses>>,
    /// Keyed by Flat's version and Foam's.
    loaded: HashMap<(String, String), LoadedReferences>,
}

/// The direct sound of each pair of a surface, and Flat's values without it.
#[derive(Debug, Clone)]
pub(crate) struct ReferenceResponses {
    direct: Arc<MeanResponses>,
    flat: Arc<FlatPairs>,
    /// Residual of Flat; None if it cannot be measured.
    pub flat_residual: Option<DirectSoundResidual>,
    /// Change of energies with the temperature of the air.
    pub air: Arc<TemperatureResponse>,
}

/// References as the lake subtracts them, and those without Foam's reflection.
#[derive(Debug, Clone)]
pub(crate) struct LoadedReferences {
    pub chosen: ReferenceResponses,
    /// None if Foam's reflection cannot be estimated: few pairs, or arrivals that are not apart.
    pub estimated: Option<ReferenceResponses>,
    /// The surface whose only run Flat's energies are from.
    pub only_flat: Option<SurfaceId>,
}

/// One finder for all workers: they share its cache.
pub(crate) type SharedFinder = Arc<Mutex<ReferenceFinder>>;

/// The surfaces that a surface names as its references.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ReferenceNames {
    pub flat: SurfaceId,
    pub foam: SurfaceId,
}

impl ReferenceNames {
    /// Returns the names that a run's surface gives, else the lake's.
    pub fn from_surface(surface: &SurfaceRecord, references: &ReferenceSurfaces) -> Self {
        Self {
            flat: surface.flat_reference.clone().unwrap_or_else(|| references.flat.clone()),
            foam: surface.foam_reference.clone().unwrap_or_else(|| references.foam.clone()),
        }
    }
}

/// The references of a surface, as far as the lake has them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct WantedReferences {
    pub flat: ReferenceVersion,
    pub foam: ReferenceVersion,
    /// Flat's own Foam.
    flat_foam: ReferenceVersion,
    direct_sound: DirectSound,
}

/// One reference.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ReferenceVersion {
    pub surface: SurfaceId,
    /// None if the lake has no run of the surface.
    pub version: Option<String>,
}

impl ReferenceVersion {
    // Means are known by it.
    fn version_key(&self) -> &str {
        self.version.as_deref().unwrap_or_default()
    }
}

impl ReferenceFinder {
    pub fn new(lake: &Lake, snapshot: Arc<LakeSnapshot>) -> Self {
        let mut runs: HashMap<_, Vec<_>> = HashMap::new();
        for run in snapshot.runs() {
            runs.entry(run.surface.clone()).or_default().push(format!("{}.{}", run.run, run.run_derivation));
        }
        // `flat:2:1f00ab...`: the surface, the number of runs, and a digest of their derivations.
        let version = |(surface, runs): (SurfaceId, Vec<String>)| {
            let version = format!("{surface}:{}:{}", runs.len(), digest_parts(&runs));
            (surface, version)
        };
        let versions = runs.into_iter().map(version).collect();
        let names =
            snapshot.files(Table::Surfaces).iter().flat_map(|f| names_of_file(f, &lake.config().references)).collect();
        Self { lake: lake.clone(), snapshot, names, versions, means: HashMap::new(), loaded: HashMap::new() }
    }

    pub fn new_shared(lake: &Lake, snapshot: Arc<LakeSnapshot>) -> SharedFinder {
        Arc::new(Mutex::new(Self::new(lake, snapshot)))
    }

    /// Returns the references with which the surface's rows must be derived.
    pub fn wanted_references(&self, surface: &SurfaceId) -> WantedReferences {
        self.wanted_by(self.reference_names(surface))
    }

    /// The same for a surface with these names.
    pub fn wanted_by(&self, ReferenceNames { flat, foam }: ReferenceNames) -> WantedReferences {
        let flat_foam = self.reference_names(&flat).foam;
        WantedReferences {
            flat: self.find_version(flat),
            foam: self.find_version(foam),
            flat_foam: self.find_version(flat_foam),
            direct_sound: self.lake.config().references.direct_sound,
        }
    }

    /// Loads the direct sound and the energies of Flat without it; None if a reference is missing.
    ///
    /// # Errors
    /// [`Error::FoamReflection`] if the lake wants it estimated and it cannot be.
    pub async fn load_references(
        &mut self,
        wanted: &WantedReferences,
        cores: &Cores,
    ) -> Result<Option<LoadedReferences>> {
        let Some(versions) = wanted.version_pair() else { return Ok(None) };
        if let Some(known) = self.loaded.get(&versions) {
            return Ok(Some(known.clone()));
        }
        // One after the other, each would wait for its store.
        let named = [&wanted.foam, &wanted.flat_foam, &wanted.flat];
        self.read_means(named).await?;
        let [foam, flat_foam, flat] = named.map(|of| self.means[of.version_key()].clone());
        let lake = self.lake.clone();
        let is_foam_chosen = wanted.direct_sound == DirectSound::Foam;
        let derive = move || {
            let of_foam = || ReferenceResponses::new(&lake, foam.clone(), &flat, &flat_foam);
            rayon::join(
                || is_foam_chosen.then(of_foam).transpose(),
                || estimate_references(&lake, &flat, &flat_foam, &foam),
            )
        };
        let (of_foam, estimated) = cores.compute_on_core(derive).await;
        let of_foam = of_foam?;
        let estimated = estimated?;
        let chosen = of_foam.or_else(|| estimated.clone()).ok_or_else(|| Error::FoamReflection {
            foam: wanted.foam.surface.to_string(),
            flat: wanted.flat.surface.to_string(),
        })?;
        let flat_runs = self.snapshot.runs().filter(|run| run.surface == wanted.flat.surface).count();
        let only_flat = (flat_runs == 1).then(|| wanted.flat.surface.clone());
        let loaded = LoadedReferences { chosen, estimated, only_flat };
        self.loaded.insert(versions, loaded.clone());
        Ok(Some(loaded))
    }

    // Reads the means that are not known yet side by side.
    async fn read_means(&mut self, named: [&ReferenceVersion; 3]) -> Result<()> {
        // Foam is most often that of Flat, too.
        let named = named.into_iter().map(|of| (of.version_key(), of));
        let unknown: BTreeMap<_, _> = named.filter(|(key, _)| !self.means.contains_key(*key)).collect();
        let read = unknown.into_iter().map(|(key, of)| {
            let means = self.compute_mean(of);
            async move { Ok::<_, Error>((key.to_owned(), Arc::new(means.await?))) }
        });
        let read = try_join_all(read).await?;
        self.means.extend(read);
        Ok(())
    }

    async fn compute_mean(&self, of: &ReferenceVersion) -> Result<MeanResponses> {
        // Number of responses, the sum of their temperatures, and that of their samples.
        let mut sums: HashMap<u32, (u32, f64, Vec<f64>)> = HashMap::new();
        for run in self.snapshot.runs().filter(|r| r.surface == of.surface) {
            let responses = read_back::read_responses(&self.lake, &self.snapshot, &run.run).await?;
            let length = self.lake.rig().impulse_response.length;
            let measured = responses.pairs.iter().zip(&responses.celsius).zip(responses.irs.chunks_exact(length));
            for ((pair, celsius), ir) in measured {
                let (count, warmth, sum) = sums.entry(*pair).or_insert_with(|| (0, 0.0, vec![0.0; length]));
                *count += 1;
                *warmth += celsius;
                sum.iter_mut().zip(ir).for_each(|(s, x)| *s += f64::from(*x));
            }
        }
        let mean = |(pair, (count, warmth, sum)): (u32, (u32, f64, Vec<f64>))| {
            let ir = sum.into_iter().map(|s| (s / f64::from(count)) as f32).collect();
            (pair, MeanResponse { ir, celsius: warmth / f64::from(count) })
        };
        Ok(sums.into_iter().map(mean).collect())
    }

    fn find_version(&self, surface: SurfaceId) -> ReferenceVersion {
        ReferenceVersion { version: self.versions.get(&surface).cloned(), surface }
    }

    // The lake's defaults for an unknown surface.
    fn reference_names(&self, surface: &SurfaceId) -> ReferenceNames {
        let references = &self.lake.config().references;
        let defaults = || ReferenceNames { flat: references.flat.clone(), foam: references.foam.clone() };
        self.names.get(surface).cloned().unwrap_or_else(defaults)
    }
}

// The names in the rows of a file's surfaces, which are the same in all of them, taken from the file's statistics.
fn names_of_file(file: &DataFile, references: &ReferenceSurfaces) -> Vec<(SurfaceId, ReferenceNames)> {
    let surfaces = match FileName::parse(&file.path) {
        Some(FileName::Rows { surface, .. }) => vec![surface],
        _ => file.visible_parts().map(|(part, _)| part.surface.clone()).collect(),
    };
    let text = |column: &str| file.stats.as_ref()?.min.get(column)?.as_str()?.parse().ok();
    let names = ReferenceNames {
        flat: text("flat_reference").unwrap_or_else(|| references.flat.clone()),
        foam: text("foam_reference").unwrap_or_else(|| references.foam.clone()),
    };
    surfaces.into_iter().map(|surface| (surface, names.clone())).collect()
}

impl ReferenceResponses {
    // `direct` is subtracted from a surface's responses, `flat_direct` from Flat's.
    fn new(lake: &Lake, direct: Arc<MeanResponses>, flat: &MeanResponses, flat_direct: &MeanResponses) -> Result<Self> {
        let rig = lake.rig();
        let plan = derivation_plan(rig).map_err(kernel_error)?;
        let mut scratch = plan.make_scratch();
        let length = rig.impulse_response.length;
        let mut power = vec![0.0; length / 2 + 1];
        let reflected: Vec<_> = sorted_means(flat)
            .into_iter()
            .filter_map(|(pair, flat)| {
                let direct = flat_direct.get(&pair)?;
                let mut reflected = vec![0.0; length];
                subtract_foam(&flat.ir, &direct.ir, &mut reflected);
                Some((pair, reflected, direct, flat.celsius))
            })
            .collect();
        for (_, reflected, ..) in &reflected {
            plan.add_power(reflected, &mut power, &mut scratch).map_err(kernel_error)?;
        }
        let air = temperature_response(rig, &power).map_err(kernel_error)?;
        let mut residual = residual_fit(rig).map_err(kernel_error)?;
        let mut pairs = FlatPairs::with_capacity(flat.len());
        for (pair, reflected, direct, celsius) in reflected {
            let energies = plan.flat_energies(&reflected, &mut scratch).map_err(kernel_error)?;
            let mut sensitivities = vec![EnergySensitivity::default(); energies.bands.len()];
            // Flat's air is what temperatures are told from.
            plan.compute_sensitivities(&reflected, &direct.ir, |_| 0.0, &mut sensitivities, &mut scratch)
                .map_err(kernel_error)?;
            if let Some([direct_secs, reflected_secs]) = arrival_times(lake, pair) {
                residual.add_pair(&reflected, &direct.ir, direct_secs, reflected_secs).map_err(kernel_error)?;
            }
            pairs.insert(pair, FlatPair { energies, sensitivities, celsius });
        }
        Ok(Self { direct, flat: Arc::new(pairs), flat_residual: residual.finish(), air: Arc::new(air) })
    }

    /// Returns the direct sound of a pair and its values of Flat, if the references have the pair.
    pub fn of_pair(&self, pair: u32) -> Option<(&[f32], &FlatPair)> {
        Some((self.direct.get(&pair)?.ir.as_slice(), self.flat.get(&pair)?))
    }
}

/// Returns the arrivals of a pair's direct sound and of its reflection in the panel's plane, s.
pub(crate) fn arrival_times(lake: &Lake, pair: u32) -> Option<[f64; 2]> {
    let points = lake.grid().pair(PairId(pair))?;
    let position = |point| lake.grid().point(point).map(|point| point.position_mm);
    let microphone = position(points.microphone)?;
    let speaker = position(points.speaker)?;
    let reference_c = lake.rig().impulse_response.reference_temperature_c.get();
    Some(
        [direct_mm(microphone, speaker), image_mm(microphone, speaker)]
            .map(|mm| mm / 1e3 / speed_of_sound(reference_c)),
    )
}

// In one order, so that sums are the same in every process.
fn sorted_means(means: &MeanResponses) -> Vec<(u32, &MeanResponse)> {
    let mut pairs: Vec<_> = means.iter().map(|(pair, mean)| (*pair, mean)).collect();
    pairs.sort_unstable_by_key(|(pair, _)| *pair);
    pairs
}

fn kernel_error(cause: echolake_dsp::Error) -> Error {
    Error::Kernel { file: "the reference".to_owned(), cause }
}

// References without Foam's reflection. Flat's Foam may be another one than the surface's: both are of the same
// material.
fn estimate_references(
    lake: &Lake,
    flat: &MeanResponses,
    flat_foam: &MeanResponses,
    foam: &MeanResponses,
) -> Result<Option<ReferenceResponses>> {
    let rig = lake.rig();
    let mut fit = FoamReflectionFit::new(rig.impulse_response.length, rig.sweep.rate_hz.get()).map_err(kernel_error)?;
    for (pair, flat) in sorted_means(flat) {
        let (Some(foam), Some([direct_secs, reflected_secs])) = (flat_foam.get(&pair), arrival_times(lake, pair))
        else {
            continue;
        };
        fit.add_pair(&foam.ir, &flat.ir, direct_secs, reflected_secs).map_err(kernel_error)?;
    }
    let Some(reflection) = fit.finish() else { return Ok(None) };
    let direct_sound = |foam: &MeanResponses| -> Result<MeanResponses> {
        let mut direct = MeanResponses::with_capacity(foam.len());
        for (pair, foam) in foam {
            let Some(flat) = flat.get(pair) else { continue };
            let mut ir = vec![0.0; foam.ir.len()];
            reflection.direct_sound(&foam.ir, &flat.ir, &mut ir).map_err(kernel_error)?;
            direct.insert(*pair, MeanResponse { ir, celsius: foam.celsius });
        }
        Ok(direct)
    };
    ReferenceResponses::new(lake, Arc::new(direct_sound(foam)?), flat, &direct_sound(flat_foam)?).map(Some)
}

impl WantedReferences {
    /// Returns Flat's version and Foam's; None if one is missing. Flat's version includes that of its own Foam.
    pub fn version_pair(&self) -> Option<(String, String)> {
        let flat = self.flat.version.as_ref()?;
        let flat_foam = self.flat_foam.version.as_ref()?;
        Some((format!("{flat}-{}", digest_parts(&[flat_foam])), self.foam.version.clone()?))
    }

    /// Returns the derivation's name for a run with these references.
    pub fn derivation_name(&self, run_derivation: &str) -> Option<String> {
        let (flat, foam) = self.version_pair()?;
        Some(digest_parts(&[run_derivation, &flat, &foam, CODE_VERSION, ROWS_REVISION, self.direct_sound.name()]))
    }

    /// Returns the names of the missing references, for messages.
    pub fn missing_names(&self) -> String {
        let absent = [&self.flat, &self.foam, &self.flat_foam].into_iter().filter(|f| f.version.is_none());
        let names: BTreeSet<_> = absent.map(|f| f.surface.as_str()).collect();
        names.into_iter().collect::<Vec<_>>().join(", ")
    }
}

/// Returns a short digest of parts, none of which contains a line break.
pub(crate) fn digest_parts(parts: &[impl AsRef<str>]) -> String {
    let mut sha = Sha256::new();
    for part in parts {
        sha.update(part.as_ref());
        sha.update("\n");
    }
    hex::encode(sha.finalize())[..VERSION_DIGITS].to_owned()
}
