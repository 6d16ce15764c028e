"""A scene that is trained already, made small."""
