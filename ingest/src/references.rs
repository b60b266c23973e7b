//! The references that a surface names: which runs they are, their version, and their mean responses.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use echolake_lake::{FileName, Lake, References, Snapshot};
use echolake_schema::{SurfaceId, SurfaceRecord};
use echolake_schema::tables::Table;
use sha2::{Digest as _, Sha256};
use tokio::sync::Mutex;

use crate::CODE_VERSION;
use crate::derive::Means;
use crate::error::Result;
use crate::read_back;
use crate::run_reader::hex;

/// Hex digits that a version keeps of its digest.
const VERSION_DIGITS: usize = 12;

/// Finds references in one snapshot, and keeps what it loaded.
pub(crate) struct Finder {
    lake: Lake,
    snapshot: Arc<Snapshot>,
    /// By version: means change with the runs, and then so does the version.
    means: HashMap<String, Arc<Means>>,
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
    pub(crate) fn of(surface: &SurfaceRecord, references: &References) -> Self {
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
    pub(crate) fn new(lake: &Lake, snapshot: Arc<Snapshot>) -> Self {
        Self { lake: lake.clone(), snapshot, means: HashMap::new() }
    }

    pub(crate) fn shared(lake: &Lake, snapshot: Arc<Snapshot>) -> SharedFinder {
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

    /// Mean responses of Foam, and of Flat with its Foam subtracted; None where one is missing.
    pub(crate) async fn load(&mut self, wanted: &Wanted) -> Result<Option<(Arc<Means>, Arc<Means>)>> {
        let Some((flat, _)) = wanted.versions() else { return Ok(None) };
        let foam = self.mean(&wanted.foam).await?;
        if let Some(known) = self.means.get(&flat) {
            return Ok(Some((foam, known.clone())));
        }
        let flat_foam = self.mean(&wanted.flat_foam).await?;
        let raw = self.mean(&wanted.flat).await?;
        let subtracted = raw.iter().filter_map(|(pair, ir)| {
            let foam = flat_foam.get(pair)?;
            Some((*pair, ir.iter().zip(foam).map(|(a, b)| a - b).collect()))
        });
        let subtracted: Arc<Means> = Arc::new(subtracted.collect());
        self.means.insert(flat, subtracted.clone());
        Ok(Some((foam, subtracted)))
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
        Found { version: self.version(&surface), surface }
    }

    // `flat:2:1f00ab...`: the surface, how many runs, and a digest of what their rows were made from.
    fn version(&self, surface: &SurfaceId) -> Option<String> {
        let runs: Vec<_> = self.snapshot.runs().filter(|r| r.surface == *surface).collect();
        let parts: Vec<_> = runs.iter().map(|r| format!("{}.{}", r.run, r.run_derivation)).collect();
        (!runs.is_empty()).then(|| format!("{surface}:{}:{}", runs.len(), digest(&parts)))
    }

    // The names that the surface's row gives; the lake's for a surface that is not there.
    fn names(&self, surface: &SurfaceId) -> Names {
        let row = self.snapshot.files(Table::Surfaces).iter().find(|f| match FileName::parse(&f.path) {
            Some(FileName::Rows { surface: of, .. }) => of == *surface,
            _ => false,
        });
        let text = |column: &str| row?.stats.as_ref()?.min.get(column)?.as_str()?.parse().ok();
        let references = &self.lake.config().references;
        Names {
            flat: text("flat_reference").unwrap_or_else(|| references.flat.clone()),
            foam: text("foam_reference").unwrap_or_else(|| references.foam.clone()),
        }
    }
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
    hex(&sha.finalize())[..VERSION_DIGITS].to_owned()
}
