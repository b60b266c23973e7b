//! The state of the catalogue's pages in this build, so that a program without them says so before a browser does.

/// The catalogue's pages in this build of the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CataloguePages {
    /// They are part of it.
    Embedded,
    /// Node was missing or too old when it was built.
    NotBuilt,
    /// It was built without the feature `web`.
    LeftOut,
}

impl CataloguePages {
    /// The pages of this build.
    pub const THIS_BUILD: Self = if cfg!(not(feature = "web")) {
        Self::LeftOut
    } else if cfg!(pages_not_built) {
        Self::NotBuilt
    } else {
        Self::Embedded
    };

    /// Returns why there are no pages and how to get them; `None` if they are there.
    pub fn missing_reason(self) -> Option<&'static str> {
        match self {
            Self::Embedded => None,
            Self::NotBuilt => Some(
                "built without the catalogue's pages, because Node was missing or too old; hint: `pip install \
                 echolake`, or install Node 20.19 (or 22.12) or newer with npm and build again",
            ),
            Self::LeftOut => Some(
                "built without the catalogue's pages (feature `web`); hint: `pip install echolake`, or build with \
                 default features",
            ),
        }
    }
}
