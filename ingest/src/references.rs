//! The references that a surface names: their runs, their versions, and their mean responses.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use echolake_dsp::Complex;
use echolake_dsp::air::AirState;
use echolake_dsp::air_correction::{AirCorrection, AirScratch, PairAir, TransformedResponse};
use echolake_dsp::foam::subtract_foam;
use echolake_dsp::foam_reflection::{FoamReflection, FoamReflectionFit, ReflectionPath};
use echolake_dsp::geometry::{direct_mm, image_mm, incidence_deg, specular_point};
use echolake_dsp::temperature::ReferenceAir;
use echolake_dsp::uncertainty::{DirectSoundResidual, DirectSoundWaveform, EnergySensitivity};
use echolake_lake::{
    DirectSound, Lake, LakeSnapshot, ReferenceNames, SamplePrecision, SurfaceReferences, VisibleRun, verdict_mark,
};
use echolake_schema::annotations::RejectedMeasurements;
use echolake_schema::{PairId, Rig, SurfaceId};
use futures::future::try_join_all;
use rayon::iter::{IntoParallelRefMutIterator as _, ParallelIterator as _};
use sha2::{Digest as _, Sha256};
use tokio::sync::Mutex;

use crate::CODE_VERSION;
use crate::derived_values::{FlatPair, MeanResponse, MeanResponses, air_correction_fit, derivation_plan, residual_fit};
use crate::error::{Error, Result};
use crate::pipeline::Cores;
use crate::read_back;

/// Revision of the rows that follow from references: those of another one are derived again. `revision_tests.rs` fails
/// if the numbers change and it does not.
pub(crate) const ROWS_REVISION: &str = "11";
/// Number of hex digits of a digest in a version.
const VERSION_DIGITS: usize = 12;

/// Finds references in one snapshot, and caches their responses.
pub(crate) struct ReferenceFinder {
    lake: Lake,
    snapshot: Arc<LakeSnapshot>,
    /// Measurements that no mean is made of.
    rejected: Arc<RejectedMeasurements>,
    /// The references that each surface's row names.
    names: SurfaceReferences,
    versions: HashMap<SurfaceId, String>,
    /// Keyed by version: the means change with the runs, and so does the version.
    means: HashMap<String, Arc<MeanResponses>>,
    /// Keyed by Flat's version and Foam's.
    loaded: HashMap<(String, String), Arc<LoadedReferences>>,
}

/// The references of a surface: the direct sound of each pair, and Flat's values without it.
pub(crate) struct LoadedReferences {
    pairs: HashMap<u32, ReferencePair>,
    /// Residual of Flat; None if it cannot be measured.
    pub flat_residual: Option<DirectSoundResidual>,
    /// Number of estimates of Foam's reflection; 0 if it cannot be estimated: few pairs, or arrivals that are not
    /// apart.
    pub estimate_count: usize,
    /// The surface whose only run Flat's energies are from.
    pub only_flat: Option<SurfaceId>,
    correction: AirCorrection<f32>,
}

/// Values with which all responses of a pair are derived.
pub(crate) struct ReferencePair {
    pub paths: PairPaths,
    pub direct: TransformedResponse<f32>,
    /// Air of the direct sound.
    air: AirState,
    /// The direct sound for [`ResidualFit::add_pair`](echolake_dsp::uncertainty::ResidualFit::add_pair).
    pub waveform: DirectSoundWaveform<f32>,
    pub flat: FlatPair,
    /// References without Foam's reflection by the best estimate, then by variants of it, whose differences show its
    /// error.
    pub unbiased: Vec<UnbiasedPair>,
}

/// A pair's references without Foam's reflection, by one estimate of it.
pub(crate) struct UnbiasedPair {
    /// Spectrum of the direct sound, `[length / 2 + 1]`.
    pub direct: Vec<Complex<f32>>,
    /// Energy of what Flat reflects.
    pub flat_total: f64,
    /// Spectrum of what Flat reflects; empty in variants.
    pub flat: Vec<Complex<f32>>,
}

/// One finder for all workers: they share its cache.
pub(crate) type SharedFinder = Arc<Mutex<ReferenceFinder>>;

/// The references of a surface, as far as the lake has them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct WantedReferences {
    pub flat: ReferenceVersion,
    pub foam: ReferenceVersion,
    /// Flat's own Foam.
    flat_foam: ReferenceVersion,
    direct_sound: DirectSound,
    samples: SamplePrecision,
    /// Octaves depend on it, and it may be said in a lake that has rows.
    scale: Option<String>,
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
    pub fn new(lake: &Lake, snapshot: Arc<LakeSnapshot>, rejected: Arc<RejectedMeasurements>) -> Self {
        let mut runs: HashMap<_, Vec<_>> = HashMap::new();
        for run in accepted_runs(&snapshot, &rejected) {
            let mark = verdict_mark(&rejected, &run.run).map(|mark| format!("-{mark}")).unwrap_or_default();
            runs.entry(run.surface.clone()).or_default().push(format!("{}.{}{mark}", run.run, run.run_derivation));
        }
        // `flat:2:1f00ab...`: the surface, the number of runs, and a digest of their derivations and verdicts.
        let version = |(surface, runs): (SurfaceId, Vec<String>)| {
            let version = format!("{surface}:{}:{}", runs.len(), digest_parts(&runs));
            (surface, version)
        };
        let versions = runs.into_iter().map(version).collect();
        let names = SurfaceReferences::from_snapshot(&snapshot, &lake.config().references);
        let lake = lake.clone();
        Self { lake, snapshot, rejected, names, versions, means: HashMap::new(), loaded: HashMap::new() }
    }

    pub fn new_shared(lake: &Lake, snapshot: Arc<LakeSnapshot>, rejected: Arc<RejectedMeasurements>) -> SharedFinder {
        Arc::new(Mutex::new(Self::new(lake, snapshot, rejected)))
    }

    /// Returns the references with which the surface's rows must be derived.
    pub fn wanted_references(&self, surface: &SurfaceId) -> WantedReferences {
        self.wanted_by(self.names.names_of(surface))
    }

    /// The same for a surface with these names.
    pub fn wanted_by(&self, ReferenceNames { flat, foam }: ReferenceNames) -> WantedReferences {
        let flat_foam = self.names.names_of(&flat).foam;
        WantedReferences {
            flat: self.find_version(flat),
            foam: self.find_version(foam),
            flat_foam: self.find_version(flat_foam),
            direct_sound: self.lake.config().references.direct_sound,
            samples: self.lake.config().samples,
            scale: self.lake.rig().scale.map(|scale| scale.to_string()),
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
    ) -> Result<Option<Arc<LoadedReferences>>> {
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
        let accepted = accepted_runs(&self.snapshot, &self.rejected);
        let flat_runs = accepted.filter(|run| run.surface == wanted.flat.surface).count();
        let only_flat = (flat_runs == 1).then(|| wanted.flat.surface.clone());
        let derive = move || {
            let reflections = estimate_reflections(&lake, &flat, &flat_foam)?;
            let means = match reflections.first() {
                _ if is_foam_chosen => [foam.clone(), flat_foam.clone()],
                Some(best) => {
                    let direct = Arc::new(remove_reflection(&lake, best, &foam, &flat)?);
                    let flat_direct = match Arc::ptr_eq(&foam, &flat_foam) {
                        true => direct.clone(),
                        false => Arc::new(remove_reflection(&lake, best, &flat_foam, &flat)?),
                    };
                    [direct, flat_direct]
                }
                None => return Ok(None),
            };
            let mut references = LoadedReferences::new(&lake, &means, &flat, only_flat)?;
            references.add_unbiased(&lake, &reflections, [&foam, &flat_foam], &flat)?;
            Ok::<_, Error>(Some(Arc::new(references)))
        };
        let [foam_name, flat_name] = [&wanted.foam, &wanted.flat].map(|of| of.surface.to_string());
        let found = cores.compute_on_core(derive).await?;
        let loaded = found.ok_or(Error::FoamReflection { foam: foam_name, flat: flat_name })?;
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
        // Number of responses, the sums of their air's temperature, humidity and pressure, and that of their samples.
        let mut sums: HashMap<u32, (u32, [f64; 3], Vec<f64>)> = HashMap::new();
        for run in accepted_runs(&self.snapshot, &self.rejected).filter(|r| r.surface == of.surface) {
            let responses = read_back::read_responses(&self.lake, &self.snapshot, &run.run).await?;
            let length = self.lake.rig().impulse_response.length;
            let measured = responses.pairs.iter().zip(&responses.airs).zip(responses.irs.chunks_exact(length));
            for ((pair, air), ir) in measured {
                if self.rejected.is_rejected(run.run.as_str(), *pair) {
                    continue;
                }
                let (count, airs, sum) = sums.entry(*pair).or_insert_with(|| (0, [0.0; 3], vec![0.0; length]));
                *count += 1;
                let values = [air.temperature_c, air.humidity_pct, air.pressure_hpa];
                airs.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
                sum.iter_mut().zip(ir).for_each(|(s, x)| *s += f64::from(*x));
            }
        }
        let mean = |(pair, (count, airs, sum)): (u32, (u32, [f64; 3], Vec<f64>))| {
            let ir = sum.into_iter().map(|s| (s / f64::from(count)) as f32).collect();
            let [temperature_c, humidity_pct, pressure_hpa] = airs.map(|sum| sum / f64::from(count));
            (pair, MeanResponse { ir, air: AirState { temperature_c, humidity_pct, pressure_hpa } })
        };
        Ok(sums.into_iter().map(mean).collect())
    }

    fn find_version(&self, surface: SurfaceId) -> ReferenceVersion {
        ReferenceVersion { version: self.versions.get(&surface).cloned(), surface }
    }
}

// Runs whose rejection is of some measurements are among them.
fn accepted_runs<'a>(
    snapshot: &'a LakeSnapshot,
    rejected: &'a RejectedMeasurements,
) -> impl Iterator<Item = &'a VisibleRun> + 'a {
    snapshot.runs().filter(move |run| !rejected.is_run_rejected(run.run.as_str()))
}

impl LoadedReferences {
    // The first of `means` is subtracted from a surface's responses, the other from Flat's.
    fn new(
        lake: &Lake,
        [direct, flat_direct]: &[Arc<MeanResponses>; 2],
        flat: &MeanResponses,
        only_flat: Option<SurfaceId>,
    ) -> Result<Self> {
        let rig = lake.rig();
        let plan = derivation_plan(rig).map_err(kernel_error)?;
        let mut scratch = plan.make_scratch();
        let measured: Vec<_> = sorted_means(flat)
            .into_iter()
            .filter_map(|(pair, flat)| Some((pair, flat, flat_direct.get(&pair)?, PairPaths::new(lake, pair)?)))
            .collect();
        let mut fit = air_correction_fit(rig);
        let mut without_direct = vec![0.0; rig.impulse_response.length];
        for (_, flat, direct, paths) in &measured {
            subtract_foam(&flat.ir, &direct.ir, &mut without_direct);
            fit.add_pair(&direct.ir, &without_direct, [paths.direct_m, paths.reflected_m]).map_err(kernel_error)?;
        }
        let correction = fit.finish();
        let mut air_scratch = correction.make_scratch();
        let mut reflected = correction.make_reflected();
        let mut residual = residual_fit(rig).map_err(kernel_error)?;
        let mut pairs = HashMap::with_capacity(flat.len());
        let is_same = Arc::ptr_eq(direct, flat_direct);
        let mut add_pair = |pair: u32, flat: &MeanResponse, flat_direct: &MeanResponse, paths: PairPaths| {
            let [direct_secs, reflected_secs] = paths.arrival_secs(rig);
            let own = correction.transform_response(flat_direct.ir.clone(), &mut air_scratch)?;
            let own_waveform = residual.prepare_direct(&own.spectrum, direct_secs, reflected_secs)?;
            let air = paths.in_air(&flat.air, &flat_direct.air);
            correction.subtract_direct(&flat.ir, &own, &air, &mut reflected, &mut air_scratch)?;
            let energies = plan.flat_energies(&reflected.samples, &mut scratch)?;
            let mut sensitivities = vec![EnergySensitivity::default(); energies.bands.len()];
            let by_air = |bin| correction.energy_changes(bin, paths.reflected_m);
            plan.compute_sensitivities(&reflected.spectrum, &own.spectrum, by_air, &mut sensitivities, &mut scratch)?;
            residual.add_pair(&reflected.spectrum, &own_waveform)?;
            let flat = FlatPair { energies, sensitivities, air: flat.air };
            let (direct, waveform, air) = match direct.get(&pair) {
                None => return Ok(()),
                // Most often Foam is that of Flat, too.
                Some(_) if is_same => (own, own_waveform, flat_direct.air),
                Some(other) => {
                    let direct = correction.transform_response(other.ir.clone(), &mut air_scratch)?;
                    let waveform = residual.prepare_direct(&direct.spectrum, direct_secs, reflected_secs)?;
                    (direct, waveform, other.air)
                }
            };
            pairs.insert(pair, ReferencePair { paths, direct, air, waveform, flat, unbiased: Vec::new() });
            Ok::<_, echolake_dsp::Error>(())
        };
        for (pair, flat, flat_direct, paths) in measured {
            add_pair(pair, flat, flat_direct, paths).map_err(kernel_error)?;
        }
        Ok(Self { pairs, flat_residual: residual.finish(), estimate_count: 0, only_flat, correction })
    }

    /// Returns the references of a pair, if they have it.
    pub fn find_pair(&self, pair: u32) -> Option<&ReferencePair> {
        self.pairs.get(&pair)
    }

    /// Returns the correction, for its buffers and changes of energies, and for [`ReferencePair::subtract_direct`].
    pub fn correction(&self) -> &AirCorrection<f32> {
        &self.correction
    }

    // Adds the references by each estimate to each pair that Flat and both Foams have.
    fn add_unbiased(
        &mut self,
        lake: &Lake,
        reflections: &[FoamReflection],
        [foam, flat_foam]: [&MeanResponses; 2],
        flat: &MeanResponses,
    ) -> Result<()> {
        if reflections.is_empty() {
            return Ok(());
        }
        let plan = derivation_plan(lake.rig()).map_err(kernel_error)?;
        let is_same = std::ptr::eq(foam, flat_foam);
        let Self { pairs, correction, .. } = self;
        let add_to_pair = |scratch: &mut AirScratch<f32>, (number, pair): (&u32, &mut ReferencePair)| {
            let (Some(own), Some(flat_foam), Some(flat)) = (foam.get(number), flat_foam.get(number), flat.get(number))
            else {
                return Ok(());
            };
            let mut direct = vec![0.0; flat.ir.len()];
            let mut reflected = vec![Complex::default(); flat.ir.len() / 2 + 1];
            let incidence_deg = pair.paths.incidence_deg;
            correction.take_response(&flat.ir, &pair.paths.in_air(&flat.air, &flat_foam.air), scratch)?;
            for (number, reflection) in reflections.iter().enumerate() {
                reflection.direct_sound(&flat_foam.ir, &flat.ir, incidence_deg, &mut direct)?;
                let of_flat = correction.compute_spectrum(&direct, scratch)?;
                correction.reflected_spectrum(&of_flat, &mut reflected, scratch);
                let flat_total = plan.spectrum_energy(&reflected);
                let of_best = if number == 0 { reflected.clone() } else { Vec::new() };
                let direct = match is_same {
                    true => of_flat,
                    false => {
                        reflection.direct_sound(&own.ir, &flat.ir, incidence_deg, &mut direct)?;
                        correction.compute_spectrum(&direct, scratch)?
                    }
                };
                pair.unbiased.push(UnbiasedPair { direct, flat_total, flat: of_best });
            }
            Ok::<_, echolake_dsp::Error>(())
        };
        let added = pairs.par_iter_mut().map_init(|| correction.make_scratch(), add_to_pair);
        added.collect::<std::result::Result<(), _>>().map_err(kernel_error)?;
        self.estimate_count = if self.pairs.is_empty() { 0 } else { reflections.len() };
        Ok(())
    }
}

impl ReferencePair {
    /// Computes what a surface reflects from a response that was measured in this air.
    pub fn subtract_direct(
        &self,
        correction: &AirCorrection<f32>,
        ir: &[f32],
        air: &AirState,
        reflected: &mut TransformedResponse<f32>,
        scratch: &mut AirScratch<f32>,
    ) -> std::result::Result<(), echolake_dsp::Error> {
        correction.subtract_direct(ir, &self.direct, &self.paths.in_air(air, &self.air), reflected, scratch)
    }
}

/// Lengths of a pair's direct path and of that by the panel's plane, m, and the latter's angle and point of reflection.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PairPaths {
    pub direct_m: f64,
    pub reflected_m: f64,
    pub incidence_deg: f64,
    /// Point of reflection.
    pub specular_mm: [f64; 2],
}

impl PairPaths {
    /// None if the grid has no such pair.
    pub fn new(lake: &Lake, pair: u32) -> Option<Self> {
        let points = lake.grid().pair(PairId(pair))?;
        let position = |point| lake.grid().point(point).map(|point| point.position_mm);
        let microphone = position(points.microphone)?;
        let speaker = position(points.speaker)?;
        let [direct_m, reflected_m] =
            [direct_mm(microphone, speaker), image_mm(microphone, speaker)].map(|mm| mm / 1e3);
        let incidence_deg = incidence_deg(microphone, speaker);
        Some(Self { direct_m, reflected_m, incidence_deg, specular_mm: specular_point(microphone, speaker) })
    }

    fn in_air(&self, response: &AirState, direct: &AirState) -> PairAir {
        let Self { direct_m, reflected_m, .. } = *self;
        PairAir { response: *response, direct: *direct, direct_m, reflected_m }
    }

    /// Returns the arrivals of both in a corrected response, s.
    pub fn arrival_secs(&self, rig: &Rig) -> [f64; 2] {
        let sound_m_s = ReferenceAir::from_response(&rig.impulse_response).speed_of_sound();
        [self.direct_m, self.reflected_m].map(|metres| metres / sound_m_s)
    }
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

// Estimates Foam's reflection: the best estimate, then its variants; none if there is no estimate. Flat's Foam may be
// another one than the surface's: both are of the same material.
fn estimate_reflections(lake: &Lake, flat: &MeanResponses, flat_foam: &MeanResponses) -> Result<Vec<FoamReflection>> {
    let rig = lake.rig();
    let mut fit = FoamReflectionFit::new(rig.impulse_response.length, rig.sweep.rate_hz.get()).map_err(kernel_error)?;
    for (pair, flat) in sorted_means(flat) {
        let (Some(foam), Some(paths)) = (flat_foam.get(&pair), PairPaths::new(lake, pair)) else { continue };
        let [direct_secs, reflected_secs] = paths.arrival_secs(rig);
        let path = ReflectionPath { direct_secs, reflected_secs, incidence_deg: paths.incidence_deg };
        fit.add_pair(&foam.ir, &flat.ir, path).map_err(kernel_error)?;
    }
    Ok(fit.finish().map_or_else(Vec::new, |estimate| [vec![estimate.best], estimate.variants].concat()))
}

// The direct sound of each pair that Flat has, too.
fn remove_reflection(
    lake: &Lake,
    reflection: &FoamReflection,
    foam: &MeanResponses,
    flat: &MeanResponses,
) -> Result<MeanResponses> {
    let mut direct = MeanResponses::with_capacity(foam.len());
    for (pair, foam) in foam {
        let (Some(flat), Some(paths)) = (flat.get(pair), PairPaths::new(lake, *pair)) else { continue };
        let mut ir = vec![0.0; foam.ir.len()];
        reflection.direct_sound(&foam.ir, &flat.ir, paths.incidence_deg, &mut ir).map_err(kernel_error)?;
        direct.insert(*pair, MeanResponse { ir, air: foam.air });
    }
    Ok(direct)
}

impl WantedReferences {
    /// Returns Flat's version and Foam's; None if one is missing. Flat's version includes that of its own Foam.
    pub fn version_pair(&self) -> Option<(String, String)> {
        let flat = self.flat.version.as_ref()?;
        let flat_foam = self.flat_foam.version.as_ref()?;
        Some((format!("{flat}-{}", digest_parts(&[flat_foam])), self.foam.version.clone()?))
    }

    /// Returns the derivation's name for a run with these references, and this mark of the verdicts on it.
    pub fn derivation_name(&self, run_derivation: &str, verdicts: Option<&str>) -> Option<String> {
        let (flat, foam) = self.version_pair()?;
        let mut parts = vec![run_derivation, &flat, &foam, CODE_VERSION, ROWS_REVISION];
        parts.extend([self.direct_sound.name(), self.samples.name()]);
        parts.extend(self.scale.as_deref());
        parts.extend(verdicts);
        Some(digest_parts(&parts))
    }

    /// The surfaces.
    pub fn surfaces(&self) -> [&SurfaceId; 3] {
        [&self.flat, &self.foam, &self.flat_foam].map(|reference| &reference.surface)
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
