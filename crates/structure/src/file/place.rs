//! Reads `[place]`.

use crate::coordinates::Coordinates;
use crate::section::{Allowed, Section};
use toml::Spanned;

/// Reads `[place]`; without the table the structure is not on the map.
pub(super) fn read_place(section: Option<Section<'_>>) -> Option<Coordinates> {
    let mut section = section?;
    let latitude = section.required_number("latitude", Allowed::LATITUDE);
    let longitude = section.required_number("longitude", Allowed::LONGITUDE);
    section.finish();
    Some(Coordinates {
        latitude: latitude.map(Spanned::into_inner)?,
        longitude: longitude.map(Spanned::into_inner)?,
    })
}

#[cfg(test)]
mod tests {
    use crate::Coordinates;
    use crate::file::tests::{DEMO, mistakes, read};

    fn with(place: &str) -> String {
        format!("{DEMO}\n[place]\n{place}\n")
    }

    /// The map is not part of the identification, so that a learnt reference stays valid.
    #[test]
    fn coordinates_are_read_and_change_no_identification() {
        let structure = read(&with("latitude = -33.857\nlongitude = 151")).unwrap();
        let expected = Coordinates {
            latitude: -33.857,
            longitude: 151.0,
        };
        assert_eq!(structure.coordinates(), Some(expected));
        let demo = read(DEMO).unwrap();
        assert_eq!(demo.coordinates(), None);
        assert_eq!(
            structure.identification_basis(),
            demo.identification_basis()
        );
    }

    #[test]
    fn contact_and_runbook_are_read_and_change_no_identification() {
        let with =
            |keys: &str| DEMO.replacen("[structure]\n", &format!("[structure]\n{keys}\n"), 1);
        let keys = "contact = \"Ada, +41 44 123 45 67\"\nrunbook = \"https://site.example/alarm\"";
        let structure = read(&with(keys)).unwrap();
        assert_eq!(structure.contact(), "Ada, +41 44 123 45 67");
        assert_eq!(structure.runbook(), Some("https://site.example/alarm"));
        let demo = read(DEMO).unwrap();
        assert_eq!((demo.contact(), demo.runbook()), ("", None));
        assert_eq!(
            structure.identification_basis(),
            demo.identification_basis()
        );
        for wrong in ["javascript:alert(1)", "https://", "https://a b"] {
            assert_eq!(
                mistakes(&with(&format!("runbook = \"{wrong}\""))),
                [format!(
                    "structure.runbook: is \"{wrong}\", \
                     must be an address that begins with https:// or http://"
                )]
            );
        }
    }

    #[test]
    fn coordinates_outside_the_earth_are_rejected() {
        assert_eq!(
            mistakes(&with("latitude = 90.5\nlongitude = -181\nheight = 3")),
            [
                "place.latitude: is 90.5, must be a finite number from -90 and up to 90",
                "place.longitude: is -181, must be a finite number from -180 and up to 180",
                "place.height: is not a known key, must be one of latitude, longitude",
            ]
        );
        assert_eq!(
            mistakes(&with("latitude = 47.376")),
            ["place.longitude: is missing, must be a finite number from -180 and up to 180"]
        );
    }
}
