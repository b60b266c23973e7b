//! DataFusion's own functions, for more kinds of arguments.

pub(crate) mod call_limits;
mod call_size;
pub(crate) mod call_stop;
pub(crate) mod exact_aggregates;
pub(crate) mod limited_aggregates;
pub(crate) mod list_members;
pub(crate) mod list_texts;
pub(crate) mod number_ranges;
pub(crate) mod octet_length;
pub(crate) mod shared_percentiles;
pub(crate) mod text_concatenation;
pub(crate) mod time_patterns;
pub(crate) mod unified_floats;
pub(crate) mod zone_times;
