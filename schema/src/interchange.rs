//! Columns of the CSV files that imports read and exports write, so that what goes out comes back in.

/// The manifest of WAV recordings; the first five are needed, and the temperature unless
/// the rig measures at full scale.
pub const WAV_MANIFEST: [&str; 13] = [
    "surface",
    "recording",
    "loopback",
    "microphone",
    "speaker",
    "temperature_c",
    "humidity_pct",
    "pressure_hpa",
    "recorded_at",
    "attempt",
    "material",
    "role",
    "scale",
];
/// The manifest of responses of REW; the first five are needed.
pub const REW_MANIFEST: [&str; 11] = [
    "surface",
    "response",
    "microphone",
    "speaker",
    "timing_offset_ms",
    "temperature_c",
    "start_secs",
    "recorded_at",
    "material",
    "role",
    "scale",
];
/// GIR's `combinations.csv`: the order of the matrix's rows, from 1.
pub const GIR_COMBINATIONS: [&str; 7] =
    ["combination", "mic_layer", "mic_x", "mic_y", "speaker_layer", "speaker_x", "speaker_y"];
/// GIR's `panel_info.csv`: what each surface is.
pub const GIR_PANEL_INFO: [&str; 7] = [
    "panel id",
    "flat reference",
    "foam reference",
    "macrostructure reference",
    "mesostructure reference",
    "sand type",
    "binder type",
];
