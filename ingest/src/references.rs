//! The references that a surface names: which runs they are, their version, and their mean responses.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use echolake_lake::{DataFile, FileName, Lake, LakeSnapshot, ReferenceSurfaces};
use echolake_schema::tables::Table;
use echolake_schema::{Rig, SurfaceId, SurfaceRecord};
use sha2::{Digest as _, Sha256};
use tokio::sync::Mutex;

use crate::CODE_VERSION;
use crate::derived_values::{Flats, Means, derivation_plan};
use crate::error::{Error, Result};
use crate::read_back;

/// Hex digits that a version keeps of its digest.
const VERSION_DIGITS: usize = 12;

/// Finds references in one snapshot, and keeps what it loaded.
pub(crate) struct Finder {
    lake: Lake,
    snapshot: Arc<LakeSnapshot>,
    /// The references that each surface's row names.
    names: HashMap<SurfaceId, Names>,
    versions: HashMap<SurfaceId, String>,
    /// By version: means change with the runs, and then so does the version.
    means: HashMap<String, Arc<Means>>,
    flats: HashMap<String, Arc<Flats>>,
}

/// One finder for all workers: what one has loaded, the others use.
pub(crate) type SharedFinder = Arc<Mutex<Finder>>;

/// The surfaces that a surface names as its references.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Names {
    pub(crate) flat: SurfaceId,
    pub(crate) foam: SurfaceId,
}

impl Names {
    /// Those that a run's surface gives, else the lake's.
    pub(crate) fn of(surface: &SurfaceRecord, references: &ReferenceSurfaces) -> Self {
        Self {
            flat: surface.flat_reference.clone().unwrap_or_else(|| references.flat.clone()),
            foam: surface.foam_reference.clone().unwrap_or_else(|| references.foam.clone()),
        }
    }
}

/// The references of a surface, as far as they are there.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Wanted {
    pub(crate) flat: Found,
    pub(crate) foam: Found,
    /// Flat's own Foam.
    flat_foam: Found,
}

/// One reference.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Found {
    pub(crate) surface: SurfaceId,
    /// None where no run carries the name.
    pub(crate) version: Option<String>,
}

impl Finder {
    pub(crate) fn new(lake: &Lake, snapshot: Arc<LakeSnapshot>) -> Self {
        let mut runs: HashMap<_, Vec<_>> = HashMap::new();
        for run in snapshot.runs() {
            runs.entry(run.surface.clone()).or_default().push(format!("{}.{}", run.run, run.run_derivation));
        }
        // `flat:2:1f00ab...`: the surface, how many runs, and a digest of what their rows were made from.
        let version = |(surface, runs): (SurfaceId, Vec<String>)| {
            let version = format!("{surface}:{}:{}", runs.len(), digest(&runs));
            (surface, version)
        };
        let versions = runs.into_iter().map(version).collect();
        let names =
            snapshot.files(Table::Surfaces).iter().filter_map(|f| names(f, &lake.config().references)).collect();
        Self { lake: lake.clone(), snapshot, names, versions, means: HashMap::new(), flats: HashMap::new() }
    }

    pub(crate) fn shared(lake: &Lake, snapshot: Arc<LakeSnapshot>) -> SharedFinder {
        Arc::new(Mutex::new(Self::new(lake, snapshot)))
    }

    /// What the surface's rows are to be derived with.
    pub(crate) fn wanted(&self, surface: &SurfaceId) -> Wanted {
        self.wanted_by(self.names(surface))
    }

    /// The same for a surface that names these.
    pub(crate) fn wanted_by(&self, Names { flat, foam }: Names) -> Wanted {
        let flat_foam = self.names(&flat).foam;
        Wanted { flat: self.found(flat), foam: self.found(foam), flat_foam: self.found(flat_foam) }
    }

    /// Mean responses of Foam, and energies of Flat's with its Foam subtracted; None where one is missing.
    pub(crate) async fn load(&mut self, wanted: &Wanted) -> Result<Option<(Arc<Means>, Arc<Flats>)>> {
        let Some((version, _)) = wanted.versions() else { return Ok(None) };
        let foam = self.mean(&wanted.foam).await?;
        if let Some(known) = self.flats.get(&version) {
            return Ok(Some((foam, known.clone())));
        }
        let flat_foam = self.mean(&wanted.flat_foam).await?;
        let flat = self.mean(&wanted.flat).await?;
        let flats = Arc::new(flats(self.lake.rig(), &flat, &flat_foam)?);
        self.flats.insert(version, flats.clone());
        Ok(Some((foam, flats)))
    }

    async fn mean(&mut self, of: &Found) -> Result<Arc<Means>> {
        let key = of.version.clone().unwrap_or_default();
        if let Some(known) = self.means.get(&key) {
            return Ok(known.clone());
        }
        let mut sums: HashMap<u32, (u32, Vec<f64>)> = HashMap::new();
        for run in self.snapshot.runs().filter(|r| r.surface == of.surface) {
            let responses = read_back::responses(&self.lake, &self.snapshot, &run.run).await?;
            let length = self.lake.rig().impulse_response.length;
            for (pair, ir) in responses.pairs.iter().zip(responses.irs.chunks_exact(length)) {
                let (count, sum) = sums.entry(*pair).or_insert_with(|| (0, vec![0.0; length]));
                *count += 1;
                sum.iter_mut().zip(ir).for_each(|(s, x)| *s += f64::from(*x));
            }
        }
        let mean = |(pair, (count, sum)): (u32, (u32, Vec<f64>))| {
            (pair, sum.into_iter().map(|s| (s / f64::from(count)) as f32).collect())
        };
        let means: Arc<Means> = Arc::new(sums.into_iter().map(mean).collect());
        self.means.insert(key, means.clone());
        Ok(means)
    }

    fn found(&self, surface: SurfaceId) -> Found {
        Found { version: self.versions.get(&surface).cloned(), surface }
    }

    // The lake's for a surface that is not there.
    fn names(&self, surface: &SurfaceId) -> Names {
        let references = &self.lake.config().references;
        let defaults = || Names { flat: references.flat.clone(), foam: references.foam.clone() };
        self.names.get(surface).cloned().unwrap_or_else(defaults)
    }
}

// The names that a surface's row gives, which stand in its file's statistics.
fn names(file: &DataFile, references: &ReferenceSurfaces) -> Option<(SurfaceId, Names)> {
    let Some(FileName::Rows { surface, .. }) = FileName::parse(&file.path) else { return None };
    let text = |column: &str| file.stats.as_ref()?.min.get(column)?.as_str()?.parse().ok();
    let names = Names {
        flat: text("flat_reference").unwrap_or_else(|| references.flat.clone()),
        foam: text("foam_reference").unwrap_or_else(|| references.foam.clone()),
    };
    Some((surface, names))
}

fn flats(rig: &Rig, flat: &Means, foam: &Means) -> Result<Flats> {
    let failed = |cause| Error::Kernel { file: "the reference".to_owned(), cause };
    let plan = derivation_plan(rig).map_err(failed)?;
    let mut scratch = plan.scratch();
    let mut flats = Flats::with_capacity(flat.len());
    for (pair, ir) in flat {
        let Some(foam) = foam.get(pair) else { continue };
        let subtracted: Vec<f32> = ir.iter().zip(foam).map(|(a, b)| a - b).collect();
        flats.insert(*pair, plan.flat_energies(&subtracted, &mut scratch).map_err(failed)?);
    }
    Ok(flats)
}

impl Wanted {
    /// Flat's version and Foam's; None while one is missing. Flat's numbers depend on what was subtracted from it, too.
    pub(crate) fn versions(&self) -> Option<(String, String)> {
        let (flat, flat_foam) = (self.flat.version.as_ref()?, self.flat_foam.version.as_ref()?);
        Some((format!("{flat}-{}", digest(&[flat_foam])), self.foam.version.clone()?))
    }

    /// The name of what is derived with them of a run.
    pub(crate) fn derivation(&self, run_derivation: &str) -> Option<String> {
        let (flat, foam) = self.versions()?;
        Some(digest(&[run_derivation, &flat, &foam, CODE_VERSION]))
    }

    /// The surfaces that have no run, for people.
    pub(crate) fn missing(&self) -> String {
        let absent = [&self.flat, &self.foam, &self.flat_foam].into_iter().filter(|f| f.version.is_none());
        let names: BTreeSet<_> = absent.map(|f| f.surface.as_str()).collect();
        names.into_iter().collect::<Vec<_>>().join(", ")
    }
}

/// A short digest of parts, none of which holds a line break.
pub(crate) fn digest(parts: &[impl AsRef<str>]) -> String {
    let mut sha = Sha256::new();
    for part in parts {
        sha.update(part.as_ref());
        sha.update("\n");
    }
    hex::encode(sha.finalize())[..VERSION_DIGITS].to_owned()
}
