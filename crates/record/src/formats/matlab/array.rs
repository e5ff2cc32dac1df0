//! Arrays of MATLAB: numbers, text, cells and structures.

use super::{MATRIX, tagged};
use crate::bytes::{ByteOrder, Bytes, text};
use crate::fault::Fault;

/// Maximum nesting depth of cells and structures. Deeper nesting could overflow the stack and does
/// not occur in recordings.
const DEEPEST: usize = 32;

/// The content of an array.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Array {
    /// Real numbers, column by column.
    Numbers {
        rows: usize,
        columns: usize,
        values: Vec<f64>,
    },
    /// One line of text.
    Text(String),
    /// Arrays, column by column.
    Cells(Vec<Array>),
    /// Elements, each with all fields in order.
    Structures(Vec<Vec<(String, Array)>>),
    /// A kind of array that cannot contain samples: complex, sparse, functions, objects of classes.
    Other,
}

/// The name of an array, and the array.
pub(super) type Named = (String, Array);

const CELL: u32 = 1;
const STRUCTURE: u32 = 2;
const OBJECT: u32 = 3;
const CHARACTERS: u32 = 4;
const NUMBERS: std::ops::RangeInclusive<u32> = 6..=15;
const COMPLEX_FLAG: u32 = 0x0800;

impl Array {
    /// Reads an array from the data of its element. Returns `None` if the element is empty.
    pub(super) fn read(mut data: Bytes<'_>, depth: usize) -> Result<Option<Named>, Fault> {
        if data.is_at_end() {
            return Ok(None);
        }
        if depth > DEEPEST {
            return Err(Fault::at_byte(
                0,
                "depth of cells and structures",
                depth,
                format!("at most {DEEPEST}"),
            ));
        }
        let (_, flags) = tagged(&mut data)?;
        let flags = Bytes::new(flags, data.order)
            .u32()
            .map_err(|fault| fault.moved_by(8))?;
        let shape = integers(&mut data)?;
        let name = text(tagged(&mut data)?.1);
        let class = flags & 0xff;
        let is_complex = flags & COMPLEX_FLAG != 0;
        let array = match class {
            CELL => Self::Cells(nested(&mut data, product(&shape), depth)?),
            STRUCTURE => Self::read_structures(&mut data, product(&shape), depth)?,
            CHARACTERS => Self::read_text(&mut data)?,
            class if NUMBERS.contains(&class) && !is_complex => {
                Self::read_numbers(&mut data, &shape)?
            }
            OBJECT => Self::Other,
            _ => Self::Other,
        };
        Ok(Some((name, array)))
    }

    fn read_numbers(data: &mut Bytes<'_>, shape: &[i64]) -> Result<Self, Fault> {
        let start = data.position();
        let (kind, bytes) = tagged(data)?;
        let values = numbers(kind, bytes, data.order).ok_or_else(|| {
            Fault::at_byte(
                start,
                "type of numbers",
                kind,
                "1 to 7, 9, 12 or 13 (integers and floating point)",
            )
        })?;
        let count = product(shape);
        if count != Some(values.len()) {
            let stated = shape
                .iter()
                .map(i64::to_string)
                .collect::<Vec<_>>()
                .join(" by ");
            return Err(Fault::at_byte(
                start,
                "number of values",
                values.len(),
                format!("{stated} as stated by the array"),
            ));
        }
        let rows = usize::try_from(shape.first().copied().unwrap_or(0)).unwrap_or(0);
        let columns = values.len().checked_div(rows).unwrap_or(0);
        Ok(Self::Numbers {
            rows,
            columns,
            values,
        })
    }

    fn read_text(data: &mut Bytes<'_>) -> Result<Self, Fault> {
        let (kind, bytes) = tagged(data)?;
        let order = data.order;
        Ok(Self::Text(match kind {
            4 | 17 => {
                let unit = |pair: &[u8]| match order {
                    ByteOrder::Little => u16::from_le_bytes([pair[0], pair[1]]),
                    ByteOrder::Big => u16::from_be_bytes([pair[0], pair[1]]),
                };
                let units: Vec<u16> = bytes.chunks_exact(2).map(unit).collect();
                String::from_utf16_lossy(&units).trim().to_owned()
            }
            _ => text(bytes),
        }))
    }

    fn read_structures(
        data: &mut Bytes<'_>,
        count: Option<usize>,
        depth: usize,
    ) -> Result<Self, Fault> {
        let start = data.position();
        let length = integers(data)?
            .first()
            .and_then(|length| usize::try_from(*length).ok());
        let length = length.filter(|length| *length > 0).ok_or_else(|| {
            Fault::at_byte(
                start,
                "length of field names",
                "not a positive number",
                "a positive number",
            )
        })?;
        let names: Vec<String> = tagged(data)?
            .1
            .chunks(length)
            .map(|name| text(name.split(|byte| *byte == 0).next().unwrap_or(name)))
            .collect();
        let mut elements = Vec::new();
        for _ in 0..if names.is_empty() {
            0
        } else {
            count.unwrap_or(usize::MAX)
        } {
            let fields = nested(data, Some(names.len()), depth)?;
            elements.push(names.iter().cloned().zip(fields).collect());
        }
        Ok(Self::Structures(elements))
    }

    /// Returns the text of a text array.
    pub(super) fn text(&self) -> Option<&str> {
        match self {
            Self::Text(text) => Some(text),
            Self::Numbers { .. } | Self::Cells(_) | Self::Structures(_) | Self::Other => None,
        }
    }

    /// Returns the number of an array with a single number.
    pub(super) fn number(&self) -> Option<f64> {
        match self {
            Self::Numbers { values, .. } if values.len() == 1 => values.first().copied(),
            Self::Numbers { .. }
            | Self::Text(_)
            | Self::Cells(_)
            | Self::Structures(_)
            | Self::Other => None,
        }
    }

    /// Returns the texts of a cell array if all cells are text.
    pub(super) fn texts(&self) -> Option<Vec<&str>> {
        match self {
            Self::Cells(cells) => cells.iter().map(Self::text).collect(),
            Self::Numbers { .. } | Self::Text(_) | Self::Structures(_) | Self::Other => None,
        }
    }
}

/// Reads arrays within an array. Each array consumes bytes, so a wrong count ends with the data.
fn nested(data: &mut Bytes<'_>, count: Option<usize>, depth: usize) -> Result<Vec<Array>, Fault> {
    let mut arrays = Vec::new();
    for _ in 0..count.unwrap_or(usize::MAX) {
        let start = data.position();
        let (kind, inner) = tagged(data)?;
        if kind != MATRIX {
            return Err(Fault::at_byte(
                start,
                "type of a cell or field",
                kind,
                "14 (array)",
            ));
        }
        let array = Array::read(Bytes::new(inner, data.order), depth + 1)
            .map_err(|fault| fault.moved_by(start + 8))?;
        arrays.push(array.map_or(Array::Other, |(_, array)| array));
    }
    Ok(arrays)
}

/// Returns the number of elements of a shape, or `None` if it is negative or too large.
fn product(shape: &[i64]) -> Option<usize> {
    shape.iter().try_fold(1_usize, |product, size| {
        product.checked_mul(usize::try_from(*size).ok()?)
    })
}

fn integers(data: &mut Bytes<'_>) -> Result<Vec<i64>, Fault> {
    let start = data.position();
    let (_, bytes) = tagged(data)?;
    let mut bytes = Bytes::new(bytes, data.order);
    let mut integers = Vec::new();
    while !bytes.is_at_end() {
        integers.push(i64::from(
            bytes.i32().map_err(|fault| fault.moved_by(start))?,
        ));
    }
    Ok(integers)
}

/// Converts the numbers of an element of type `kind`. Returns `None` if the type is not numeric.
fn numbers(kind: u32, bytes: &[u8], order: ByteOrder) -> Option<Vec<f64>> {
    fn all<const N: usize>(
        bytes: &[u8],
        order: ByteOrder,
        number: impl Fn([u8; N]) -> f64,
    ) -> Vec<f64> {
        bytes
            .chunks_exact(N)
            .filter_map(|chunk| chunk.try_into().ok())
            .map(|mut little: [u8; N]| {
                if order == ByteOrder::Big {
                    little.reverse();
                }
                number(little)
            })
            .collect()
    }
    Some(match kind {
        1 => all(bytes, order, |b| f64::from(i8::from_le_bytes(b))),
        2 => all(bytes, order, |b| f64::from(u8::from_le_bytes(b))),
        3 => all(bytes, order, |b| f64::from(i16::from_le_bytes(b))),
        4 => all(bytes, order, |b| f64::from(u16::from_le_bytes(b))),
        5 => all(bytes, order, |b| f64::from(i32::from_le_bytes(b))),
        6 => all(bytes, order, |b| f64::from(u32::from_le_bytes(b))),
        7 => all(bytes, order, |b| f64::from(f32::from_le_bytes(b))),
        9 => all(bytes, order, f64::from_le_bytes),
        12 => all(bytes, order, |b| i64::from_le_bytes(b) as f64),
        13 => all(bytes, order, |b| u64::from_le_bytes(b) as f64),
        _ => return None,
    })
}
