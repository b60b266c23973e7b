//! The references that a surface names: which runs they are, their version, and their mean responses.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use echolake_lake::{FileName, Lake, Snapshot};
use echolake_schema::SurfaceId;
use echolake_schema::tables::Table;
use sha2::{Digest as _, Sha256};

use crate::derive::Means;
use crate::error::Result;
use crate::read_back;
use crate::run_reader::hex;

/// Hex digits that a version keeps of its digest.
const VERSION_DIGITS: usize = 12;

/// Finds references in one snapshot, and keeps what it loaded.
pub(crate) struct Finder<'a> {
    lake: &'a Lake,
    snapshot: &'a Snapshot,
    /// By version: means change with the runs, and then so does the version.
    means: HashMap<String, Arc<Means>>,
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

impl<'a> Finder<'a> {
    pub(crate) fn new(lake: &'a Lake, snapshot: &'a Snapshot) -> Self {
        Self { lake, snapshot, means: HashMap::new() }
    }

    /// What the surface's rows are to be derived with.
    pub(crate) fn wanted(&self, surface: &SurfaceId) -> Wanted {
        let (flat, foam) = self.names(surface);
        let (_, flat_foam) = self.names(&flat);
        Wanted { flat: self.found(flat), foam: self.found(foam), flat_foam: self.found(flat_foam) }
    }

    /// Mean responses of Foam, and of Flat with its Foam subtracted; None where one is missing.
    pub(crate) async fn load(&mut self, wanted: &Wanted) -> Result<Option<(Arc<Means>, Arc<Means>)>> {
        let (Some(flat), Some(_)) = (wanted.flat_version(), &wanted.foam.version) else { return Ok(None) };
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
            let responses = read_back::responses(self.lake, self.snapshot, &run.run).await?;
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
    fn names(&self, surface: &SurfaceId) -> (SurfaceId, SurfaceId) {
        let row = self.snapshot.files(Table::Surfaces).iter().find(|f| match FileName::parse(&f.path) {
            Some(FileName::Rows { surface: of, .. }) => of == *surface,
            _ => false,
        });
        let text = |column: &str| row?.stats.as_ref()?.min.get(column)?.as_str()?.parse().ok();
        let references = &self.lake.config().references;
        (
            text("flat_reference").unwrap_or_else(|| references.flat.clone()),
            text("foam_reference").unwrap_or_else(|| references.foam.clone()),
        )
    }
}

impl Wanted {
    /// Flat's version: its numbers depend on what was subtracted from it, too.
    pub(crate) fn flat_version(&self) -> Option<String> {
        let (flat, foam) = (self.flat.version.as_ref()?, self.flat_foam.version.as_ref()?);
        Some(format!("{flat}-{}", digest(&[foam])))
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
