//! Values of options, and how they are read.

use spandrel_bus::AnnotationKind;
use spandrel_record::TimeUnit;

/// Parses a positive duration in seconds.
pub(super) fn check_seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if seconds > 0.0 && seconds <= MAX_CHECK_S => Ok(seconds),
        Ok(_) | Err(_) => Err(format!(
            "must be a number above 0 and at most {MAX_CHECK_S}"
        )),
    }
}

/// Longest check of sources, s: one day.
const MAX_CHECK_S: f64 = 86_400.0;

/// Speed at which data is sent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Speed {
    /// Multiple of real time.
    Times(f64),
    /// As fast as the receivers process the data.
    Max,
}

impl std::str::FromStr for Speed {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let allowed = || format!("is `{text}`, must be a positive number or max");
        match text {
            "max" => Ok(Self::Max),
            _ => match text.parse::<f64>() {
                Ok(times) if times.is_finite() && times > 0.0 => Ok(Self::Times(times)),
                Ok(_) | Err(_) => Err(allowed()),
            },
        }
    }
}

/// A frequency band.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Band {
    /// Lower end (Hz).
    pub lowest_hz: f64,
    /// Upper end (Hz).
    pub highest_hz: f64,
}

impl std::str::FromStr for Band {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let wrong = || "must be two increasing frequencies in Hz, such as 0.5..12".to_owned();
        let (low, high) = text.split_once("..").ok_or_else(wrong)?;
        let number = |text: &str| text.parse::<f64>().map_err(|_| wrong());
        let (lowest_hz, highest_hz) = (number(low)?, number(high)?);
        if lowest_hz >= 0.0 && lowest_hz < highest_hz && highest_hz.is_finite() {
            Ok(Self {
                lowest_hz,
                highest_hz,
            })
        } else {
            Err(wrong())
        }
    }
}

pub(super) fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value > 0.0 => Ok(value),
        Ok(_) | Err(_) => Err("must be a positive number of seconds".to_owned()),
    }
}

pub(super) fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value > 0.0 => Ok(value),
        Ok(_) | Err(_) => Err("must be a positive number".to_owned()),
    }
}

/// Reads a kind of annotation.
pub(super) fn annotation_kind(text: &str) -> Result<AnnotationKind, String> {
    AnnotationKind::from_name(text).ok_or_else(|| {
        let names: Vec<&str> = AnnotationKind::ALL
            .iter()
            .map(|kind| kind.as_str())
            .collect();
        format!("must be one of: {}", names.join(", "))
    })
}

pub(super) fn time_unit(text: &str) -> Result<TimeUnit, String> {
    TimeUnit::of_symbol(text).ok_or_else(|| "must be s, ms, us or ns".to_owned())
}

pub(super) fn share(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value <= 1.0 => Ok(value),
        Ok(_) | Err(_) => Err("must be above 0 and at most 1".to_owned()),
    }
}

pub(super) fn below_1(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value < 1.0 => Ok(value),
        Ok(_) | Err(_) => Err("must be above 0 and below 1".to_owned()),
    }
}

pub(super) fn not_negative(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value >= 0.0 => Ok(value),
        Ok(_) | Err(_) => Err("must be a number, 0 or more".to_owned()),
    }
}
