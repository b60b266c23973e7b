//! `nce`: the normalised cumulative energy curve of a response.

use std::sync::Arc;

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::error::Result;
use echolake_dsp::energy::cumulate_whole;
use echolake_dsp::filter_bank::FilterBankPlan;

use super::answers::{grow, lists};
use super::arguments::{Arguments, Element};
use super::description::{Description, Family, Kind, Parameter};
use super::per_length::PerLength;
use super::rig::Facts;
use super::scalar::Scalar;

/// `nce`.
pub(super) struct Nce(pub(super) Arc<Facts>);

static DESCRIPTION: Description = Description {
    name: "nce",
    family: Family::Responses,
    about: "Normalised cumulative energy (NCE): the energy of a response up to each of its samples over Flat's total \
            energy for the same pair; the last value is TNCE. Of the whole response, or of one band where its centre is \
            given, as the columns `nce_2500` and so on of table nce. Null where Flat has no energy.",
    parameters: &[
        Parameter { name: "ir", kind: Kind::Samples, about: "the response with Foam's subtracted, as reflected_ir" },
        Parameter {
            name: "flat_energy",
            kind: Kind::Number,
            about: "Flat's energy of the pair, sum of squares, all bands",
        },
        Parameter { name: "centre_hz", kind: Kind::Number, about: "centre of one band, Hz" },
    ],
    optional: 1,
    example: "select nce([1, 2, 0, 1], 8) as curve",
    answer: "\
+-----------------------------+
| curve                       |
+-----------------------------+
| [0.125, 0.625, 0.625, 0.75] |
+-----------------------------+",
    related: &["band_energy", "list_db", "edc"],
};

impl Scalar for Nce {
    fn description(&self) -> &'static Description {
        &DESCRIPTION
    }

    fn returns(&self, arguments: &[DataType]) -> DataType {
        super::lists::like(&arguments[0])
    }

    fn call<T: Element>(&self, arguments: &Arguments<'_>) -> Result<ArrayRef> {
        let (ir, flat) = (arguments.samples::<T>(0)?, arguments.numbers(1)?);
        let room = ir.room(arguments.rows());
        if arguments.given() == 2 {
            return lists::<T>(arguments, room, |row, out| {
                let (ir, flat) = (ir.at(row)?, flat.at(row));
                cumulate_whole(ir, flat, grow(out, ir.len()));
                Ok(flat > 0.0)
            });
        }
        let centre = arguments.numbers(2)?;
        let mut plans = PerLength::new(DESCRIPTION.name);
        lists::<T>(arguments, room, |row, out| {
            let (ir, flat, centre) = (ir.at(row)?, flat.at(row), centre.at(row));
            let band = self.0.band(centre);
            let band = band.ok_or_else(|| arguments.wrong(2, row, centre, &self.0.bands_hint()))?;
            if ir.is_empty() {
                return Ok(flat > 0.0);
            }
            let (plan, scratch, bands) = plans.get(ir.len(), |len| {
                let plan = FilterBankPlan::<T>::new(len, self.0.rate_hz, &self.0.centres_hz)?;
                let (scratch, bands) = (plan.scratch(), vec![T::default(); plan.bands() * len]);
                Ok((plan, scratch, bands))
            })?;
            plan.run(ir, bands, scratch).map_err(|e| arguments.refused(row, &e))?;
            cumulate_whole(&bands[band * ir.len()..][..ir.len()], flat, grow(out, ir.len()));
            Ok(flat > 0.0)
        })
    }
}
