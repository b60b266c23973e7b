//! Numbers and texts of a SOFA file, which is HDF5. What netCDF packs (deflate, bytes shuffled) is unpacked here.

use std::path::Path;

use rust_hdf5::{ByteOrder, DatatypeMessage, Filter, H5Dataset, H5File, Hdf5Error};

/// HDF5's numbers of its filters.
const DEFLATE: u16 = 1;
const SHUFFLE: u16 = 2;
const CHECKSUM: u16 = 3;
/// Most numbers of a variable: 4 GB of them.
const MOST: usize = 1 << 29;

/// A file that is read.
pub(super) struct SofaFile(H5File);

/// A variable.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct SofaVariable {
    pub(super) shape: Vec<usize>,
    pub(super) values: Vec<f64>,
}

impl SofaFile {
    pub(super) fn open(path: &Path) -> Result<Self, String> {
        H5File::open(path).map(Self).map_err(|e| e.to_string())
    }

    /// Returns an attribute of the file; empty if it is missing.
    pub(super) fn text(&self, name: &str) -> String {
        // Fixed lengths are filled up with zeros.
        self.0.attr_string(name).map(|text| text.trim_end_matches('\0').to_owned()).unwrap_or_default()
    }

    /// Returns an attribute of a variable; empty if it is missing.
    pub(super) fn text_of(&self, variable: &str, name: &str) -> String {
        let read = self.0.dataset(variable).and_then(|d| d.attr(name)?.read_string());
        read.map(|text| text.trim_end_matches('\0').to_owned()).unwrap_or_default()
    }

    /// Reads a variable; None if it is missing.
    pub(super) fn variable(&self, name: &str) -> Result<Option<SofaVariable>, String> {
        if !self.0.dataset_names().iter().any(|known| known == name) {
            return Ok(None);
        }
        let failed = |e: Hdf5Error| e.to_string();
        let dataset = self.0.dataset(name).map_err(failed)?;
        let shape = dataset.shape();
        let count = shape.iter().try_fold(1usize, |count, n| count.checked_mul(*n)).filter(|n| *n <= MOST);
        let count = count.ok_or_else(|| format!("{shape:?} numbers, more than {MOST}"))?;
        let filters = dataset.filters().map_err(failed)?;
        let values = match filters.is_empty() {
            true => plain(&dataset)?,
            false => packed(&dataset, &filters, &shape)?,
        };
        match values.len() == count {
            true => Ok(Some(SofaVariable { shape, values })),
            false => Err(format!("{} numbers, expected {count}", values.len())),
        }
    }
}

// Writers differ in whether a rate is an integer.
fn plain(dataset: &H5Dataset) -> Result<Vec<f64>, String> {
    match dataset.read_numeric_as::<f64>() {
        Ok(values) => Ok(values),
        Err(first) => match dataset.read_numeric_as::<i32>() {
            Ok(values) => Ok(values.into_iter().map(f64::from).collect()),
            Err(_) => Err(first.to_string()),
        },
    }
}

fn packed(dataset: &H5Dataset, filters: &[Filter], shape: &[usize]) -> Result<Vec<f64>, String> {
    let failed = |e: Hdf5Error| e.to_string();
    if let Some(unknown) = filters.iter().find(|f| ![DEFLATE, SHUFFLE, CHECKSUM].contains(&f.id)) {
        return Err(format!("it is packed by HDF5's filter {}; hint: `h5repack -f NONE` unpacks it", unknown.id));
    }
    let width = match dataset.datatype().map_err(failed)? {
        DatatypeMessage::FloatingPoint { size, byte_order: ByteOrder::LittleEndian, .. } if size == 4 || size == 8 => {
            size as usize
        }
        other => return Err(format!("numbers are {other:?}; hint: `h5repack -f NONE` unpacks them")),
    };
    let chunk = dataset.chunk_dims().filter(|c| c.len() == shape.len() && !c.contains(&0));
    let chunk = chunk.ok_or("it is packed without chunks")?;
    let cells = chunk.iter().try_fold(1usize, |n, d| n.checked_mul(*d)).filter(|n| *n <= MOST);
    let cells = cells.ok_or_else(|| format!("chunks of {chunk:?} numbers"))?;
    let mut values = vec![0.0; shape.iter().product()];
    let grid: Vec<usize> = shape.iter().zip(&chunk).map(|(n, c)| n.div_ceil(*c)).collect();
    for number in 0..grid.iter().product() {
        let at = place(number, &grid);
        let (raw, mask) = dataset.read_chunk_raw_at(&at).map_err(failed)?;
        let bytes = unpacked(raw, filters, mask, width, cells * width)?;
        for (cell, bytes) in bytes.chunks_exact(width).enumerate() {
            let within = place(cell, &chunk);
            let of_file = at.iter().zip(&chunk).zip(&within).map(|((a, c), w)| a * c + w);
            // Chunks at the edge reach beyond it.
            let index = of_file.zip(shape).try_fold(0, |index, (i, n)| (i < *n).then_some(index * n + i));
            if let Some(value) = index.and_then(|index| values.get_mut(index)) {
                *value = number_of(bytes);
            }
        }
    }
    Ok(values)
}

// The place of a number in a grid, row by row.
fn place(number: usize, grid: &[usize]) -> Vec<usize> {
    let (mut left, mut at) = (number, vec![0; grid.len()]);
    for (i, n) in grid.iter().enumerate().rev() {
        at[i] = left % n;
        left /= n;
    }
    at
}

fn number_of(bytes: &[u8]) -> f64 {
    match *bytes {
        [a, b, c, d] => f64::from(f32::from_le_bytes([a, b, c, d])),
        [a, b, c, d, e, f, g, h] => f64::from_le_bytes([a, b, c, d, e, f, g, h]),
        _ => f64::NAN,
    }
}

// Undoes the filters from the last to the first; bit i of the mask says that filter i was left out.
fn unpacked(mut bytes: Vec<u8>, filters: &[Filter], mask: u32, width: usize, size: usize) -> Result<Vec<u8>, String> {
    for (i, filter) in filters.iter().enumerate().rev().filter(|(i, _)| mask >> i & 1 == 0) {
        bytes = match filter.id {
            DEFLATE => miniz_oxide::inflate::decompress_to_vec_zlib_with_limit(&bytes, size + 4)
                .map_err(|e| format!("filter {i}: a chunk is damaged: {e}"))?,
            SHUFFLE => unshuffled(&bytes, width),
            // What it is worth, deflate's own checksum is worth, too.
            _ => bytes.get(..bytes.len().saturating_sub(4)).unwrap_or_default().to_vec(),
        };
    }
    match bytes.len() == size {
        true => Ok(bytes),
        false => Err(format!("a chunk of {} bytes, expected {size}", bytes.len())),
    }
}

// The first bytes of all numbers come first, then the second ones, and so on.
fn unshuffled(bytes: &[u8], width: usize) -> Vec<u8> {
    let count = bytes.len() / width;
    (0..count * width).map(|i| bytes[i % width * count + i / width]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn filter(id: u16) -> Filter {
        Filter { id, flags: 0, cd_values: Vec::new() }
    }

    #[test]
    fn what_netcdf_packs_is_unpacked() {
        let numbers: Vec<f64> = (0..60).map(|i| f64::from(i) / 7.0).collect();
        let plain: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
        let shuffled: Vec<u8> = (0..8).flat_map(|b| plain.iter().skip(b).step_by(8).copied()).collect();
        let deflated = miniz_oxide::deflate::compress_to_vec_zlib(&shuffled, 5);
        let filters = [filter(SHUFFLE), filter(DEFLATE)];
        assert_eq!(unpacked(deflated.clone(), &filters, 0, 8, 480).as_ref(), Ok(&plain));
        // A chunk that deflate did not make smaller is left as it is.
        assert_eq!(unpacked(shuffled, &filters, 0b10, 8, 480).as_ref(), Ok(&plain));
        assert!(unpacked(deflated.clone(), &filters, 0, 8, 400).is_err_and(|e| e.contains("damaged")));
        assert!(unpacked(deflated[..20].to_vec(), &filters, 0, 8, 480).is_err_and(|e| e.contains("damaged")));
    }

    #[test]
    fn places_count_row_by_row() {
        assert_eq!((0..6).map(|n| place(n, &[2, 3])).collect::<Vec<_>>()[3..5], [vec![1, 0], vec![1, 1]]);
    }
}
