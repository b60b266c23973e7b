//! `room_parameters`: reverberation times, clarity, definition and centre time.

use std::sync::Arc;

use arrow::array::{ArrayRef, Float64Array, StringArray, StructArray};
use arrow::datatypes::{DataType, Field, Fields};
use datafusion::error::Result;
use echolake_dsp::room_parameters::{RoomParameters, compute_room_parameters, is_long_enough};

use super::decay::require_finite;
use super::octave_band::{BandFilters, FRACTION, MIDBAND};
use crate::adapters::answers::number_fields;
use crate::adapters::arguments::{CallArguments, SampleElement};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};
use crate::adapters::rig::RigFacts;
use crate::adapters::scalar::ScalarKernel;

/// `room_parameters`.
pub(crate) struct RoomParametersFunction(pub Arc<RigFacts>);

/// A number of the answer: the name of its field, and its value.
type RoomNumber = (&'static str, fn(&RoomParameters) -> Option<f64>);

/// Fields of the answer that are numbers.
const NUMBERS: [RoomNumber; 13] = [
    ("edt_s", |room| room.edt_secs),
    ("t20_s", |room| room.t20_secs),
    ("t20_u_s", |room| room.t20_deviation_secs),
    ("t30_s", |room| room.t30_secs),
    ("t30_u_s", |room| room.t30_deviation_secs),
    ("t20_nonlinearity", |room| room.t20_non_linearity),
    ("t30_nonlinearity", |room| room.t30_non_linearity),
    ("curvature_percent", |room| room.curvature_percent),
    ("c50_db", |room| room.c50_db),
    ("c80_db", |room| room.c80_db),
    ("d50", |room| room.d50),
    ("ts_ms", |room| room.ts_secs.map(|secs| secs * 1e3)),
    ("range_db", |room| room.range_db),
];

static DESCRIPTION: FunctionDescription = FunctionDescription {
    name: "room_parameters",
    family: FunctionFamily::Responses,
    about: "Parameters of ISO 3382-1:2009 of a room's response, counted from its arrival: a struct of `edt_s`, \
            `t20_s` and `t30_s` with their standard deviations by the band's width `t20_u_s` and `t30_u_s`, the \
            decays' `t20_nonlinearity` and `t30_nonlinearity` (per mille) and `curvature_percent` of ISO \
            3382-2:2008, annex B, `c50_db`, `c80_db`, `d50` (0 to 1), `ts_ms` and `range_db`, the range of the decay \
            curve from its start to where the decay meets the noise (Lundeby's method). The response ends where its \
            last zeros begin. The noise's power is subtracted, and the energy after that point is added as the late \
            decay's. Null where the range is too short (25 dB for EDT and the energies, 35 dB for T20, 45 dB for \
            T30) or over 144 dB, where the response is shorter than 50 ms, and for times of less than 16 over the \
            bandwidth, which are the filter's own; `reason` has the cause. `doubt` says that a decay is no line, or \
            has more than one slope. Of all frequencies, or of the band of band_filter if its midband frequency is \
            given.",
    parameters: &[
        FunctionParameter {
            name: "ir",
            kind: ArgumentKind::Samples,
            about: "the response at the lake's sampling rate, as ir",
        },
        MIDBAND,
        FRACTION,
    ],
    optional: 2,
    example: "select round(room['t20_s'], 3) as t20, round(room['c50_db'], 2) as c50, round(room['ts_ms'], 2) as ts \
              from (select room_parameters(array_agg(power(10, n / -19200.0 * 3) order by n)) as room from \
              (select unnest(range(0, 19200)) as n))",
    answer: "\
+-----+-------+-------+
| t20 | c50   | ts    |
+-----+-------+-------+
| 0.2 | 14.86 | 14.47 |
+-----+-------+-------+",
    related: &["band_filter", "arrival", "edc"],
};

fn answer_fields() -> Fields {
    let numbers = number_fields(NUMBERS.map(|(name, _)| name));
    let texts = ["reason", "doubt"].map(|name| Arc::new(Field::new(name, DataType::Utf8, true)));
    numbers.iter().cloned().chain(texts).collect()
}

impl RoomParametersFunction {
    fn compute_room<T: SampleElement>(
        &self,
        arguments: &CallArguments<'_>,
        row: usize,
        ir: &[T],
        filters: Option<&mut BandFilters<'_>>,
    ) -> Result<RoomParameters> {
        require_finite(arguments, row, ir)?;
        let rate_hz = self.0.rate_hz;
        let band = filters.map(|filters| filters.filter_at(row)).transpose()?;
        // The responses of a rig of some ms have no parameters in any band.
        let band = band.filter(|_| is_long_enough(ir.len(), rate_hz));
        Ok(compute_room_parameters(ir, rate_hz, band.map(|(band, filter)| (band, filter))))
    }
}

impl ScalarKernel for RoomParametersFunction {
    fn description(&self) -> &'static FunctionDescription {
        &DESCRIPTION
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Struct(answer_fields())
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let lists = arguments.sample_lists::<T>(0)?;
        let mut filters =
            (arguments.argument_count() > 1).then(|| BandFilters::new(arguments, self.0.rate_hz)).transpose()?;
        let mut rooms = Vec::with_capacity(arguments.row_count());
        for row in 0..arguments.row_count() {
            let is_null = arguments.is_null(row);
            let ir = if is_null { &[] } else { lists.samples_at(row)? };
            let room = || self.compute_room(arguments, row, ir, filters.as_mut());
            rooms.push((!is_null).then(room).transpose()?);
        }
        let number = |(_, value): RoomNumber| -> ArrayRef {
            Arc::new(rooms.iter().map(|room| room.as_ref().and_then(value)).collect::<Float64Array>())
        };
        let text = |texts: fn(&RoomParameters) -> &[String]| -> ArrayRef {
            let joined = |room: &Option<RoomParameters>| room.as_ref().map(|room| texts(room).join("; "));
            let texts = rooms.iter().map(|room| joined(room).filter(|text| !text.is_empty()));
            Arc::new(texts.collect::<StringArray>())
        };
        let mut columns: Vec<ArrayRef> = NUMBERS.map(number).into();
        columns.extend([text(|room| &room.refusals), text(|room| &room.doubts)]);
        let nulls = rooms.iter().map(Option::is_some).collect();
        let answer = StructArray::try_new_with_length(answer_fields(), columns, Some(nulls), rooms.len())?;
        Ok(Arc::new(answer))
    }
}
