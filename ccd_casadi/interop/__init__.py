"""Between this project and other people's frameworks: tables of pandas, components of OpenMDAO."""
