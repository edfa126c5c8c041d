"""What users write: the seven model classes and the laws."""
